"""Records of views, as density control sees them, without rendering any."""

import torch

from crossgrad_core.contract.contexts import ViewRecord
from crossgrad_core.contract.gaussians import Gaussians, Screen
from crossgrad_core.contract.scene import View
from crossgrad_core.training.views import camera_at


def view_record(
    view: View, gaussians: Gaussians, screen: Screen, index: int = 0, scale: float = 1.0
) -> ViewRecord:
    """The record of a view that was drawn with these statistics, over black, beside a black photo.

    Args:
        view: The view.
        gaussians: What was drawn.
        screen: Its statistics in pixels of the render, gradients included.
        index: Position of the view in `scene.train_views`.
        scale: Sides of the render over those of the photo.
    """
    camera = camera_at(view.camera, scale)
    image = torch.zeros(camera.height, camera.width, 3)
    return ViewRecord(
        index=index,
        view=view,
        label=None,
        loss=0.1,
        gaussians=gaussians,
        screen=screen,
        background=torch.zeros(3),
        camera=camera,
        scale=scale,
        image=image,
        photo=image.to(torch.uint8),
        mask=None,
    )
