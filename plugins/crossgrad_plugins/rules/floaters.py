"""Removal of floaters at the end of a run: primitives near a camera that no training photo shows.

A step may move a Gaussian behind its camera or out of the photo at the side. Then no photo gives a
gradient for the Gaussian, so the Gaussian does not change any more. If the Gaussian is opaque, it
hides the scene in photos from nearby (docs/floaters.md). The rule was developed for crossgrad.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    Backbone,
    Edit,
    Field,
    FinalEdit,
    Model,
    Rule,
    Scene,
    View,
    apply_to_parameters,
    hookimpl,
)

#: The nearest depth of a camera is this percentile of the depths of its SfM points. The minimum is
#: not used, because single points are often wrong.
NEAREST: Final = 1.0
#: A camera that observes fewer points than this gives no reliable information about empty space.
FEWEST_SEEN: Final = 8


class Floaters(Rule):
    """Removes primitives around cameras that no training photo shows, when a run is finished."""

    empty: float = Field(
        0.3,
        gt=0,
        le=1,
        # The nearest observed point of a level camera is farther away than the ground below it,
        # because the camera sees the ground only at a distance.
        description="depth range that counts as empty, as a share of the distance from a camera "
        "to the nearest point that it observes",
    )

    @hookimpl
    def crossgrad_final_edit(self, model: Model) -> FinalEdit | None:
        """Remove the floaters, unless this would remove all primitives."""
        count, rows = _primitives(model), floaters(model, self.empty)
        if not 0 < len(rows) < count:
            return None
        kept = torch.ones(count, dtype=torch.bool, device=rows.device)
        kept[rows] = False
        return FinalEdit(Edit(kept.nonzero().squeeze(1)), removed(len(rows)))

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        if not backbone.positions:
            return "the backbone defines no positions"
        if not cameras_that_tell(scene):
            return "no photo observes enough points to show which space is empty"
        return ""


def removed(count: int) -> str:
    """Return the log line about the removal of `count` primitives."""
    were = "primitive was" if count == 1 else "primitives were"
    return (
        f"floaters: {count:,} {were} removed from the empty space around training cameras, "
        "because no training photo shows them (--no-rule floaters keeps them)"
    )


def _primitives(model: Model) -> int:
    return len(model.parameters.get(model.backbone.positions, ()))


def floaters(model: Model, empty: float) -> Tensor:
    """Return [F] int64 rows of primitives in empty space that touch no training photo.

    A primitive that is hidden by other primitives counts as touched. A primitive is therefore a
    floater only if the rasterizer omits it from every training photo.

    Args:
        model: The model at the end of the run.
        empty: Share of the distance from a camera to the nearest point that the camera sees.
    """
    parameters, backbone = model.parameters, model.backbone
    if backbone.positions not in parameters:
        return torch.zeros(0, dtype=torch.int64)
    positions = parameters[backbone.positions].detach()
    near = in_empty_space(positions.double().cpu().numpy(), model.scene, empty)
    rows = torch.from_numpy(np.flatnonzero(near)).to(positions.device)
    for view in model.scene.train_views:
        if len(rows) == 0:
            break
        # Render only the candidates, because this takes little time. Other Gaussians that hide the
        # candidates do not matter.
        alone = apply_to_parameters(Edit(rows), backbone.blocks(), parameters)
        with torch.no_grad():
            gaussians = backbone.decode(alone, view.camera, model.phase)
            render = model.rasterizer.render(gaussians, view.camera, model.background)
        drawn, origin = render.screen.radii > 0, gaussians.origin
        untouched = torch.ones_like(rows, dtype=torch.bool)
        untouched[drawn if origin is None else origin[drawn]] = False
        rows = rows[untouched]
    return rows


def cameras_that_tell(scene: Scene) -> list[View]:
    """Return the training views that observe enough points to bound the empty space."""
    return [view for view in scene.train_views if len(view.seen) >= FEWEST_SEEN]


def in_empty_space(positions: NDArray[np.float64], scene: Scene, empty: float) -> NDArray[np.bool_]:
    """Return [N] bool: True if a position is in the empty space around the nearest camera.

    Args:
        positions: [N, 3], local frame.
        scene: The scene; its training cameras and the SfM points that they see are used.
        empty: Share of the distance from a camera to the nearest point that the camera sees.
    """
    from scipy.spatial import cKDTree  # Import it here, because the import is slow.

    views = cameras_that_tell(scene)
    if not views:
        return np.zeros(len(positions), dtype=np.bool_)
    depths = (view.camera.local(scene.points[view.seen])[:, 2] for view in views)
    nearest = np.array([np.percentile(view_depths, NEAREST) for view_depths in depths])
    reach = empty * np.maximum(nearest, 0.0)
    centers = np.stack([view.camera.center.numpy() for view in views])
    distance, which = cKDTree(centers).query(positions)
    return np.asarray(distance < reach[which])
