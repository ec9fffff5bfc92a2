"""Removal of floaters at the end of a run: primitives near a camera that no training photo shows.

A step can move a Gaussian behind the camera of a photo, or out of the photo. Then no photo gives
the Gaussian a gradient, so the Gaussian stays as it is. An opaque Gaussian of this kind hides the
scene in photos that are taken near it (docs/floaters.md). This rule was developed for crossgrad.
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

#: This percentile of the depths of a camera's SfM points counts as its nearest depth. The minimum
#: is not used, because single points are often wrong.
NEAREST: Final = 1.0
#: A camera that observes fewer points than this is not used, because its nearest depth is
#: unreliable.
FEWEST_SEEN: Final = 8


class Floaters(Rule):
    """At the end of a run, removes primitives near cameras that no training photo shows."""

    empty: float = Field(
        0.3,
        gt=0,
        le=1,
        # The empty space must end far before the nearest observed point, because the ground below a
        # level camera is nearer than every point that the camera observes.
        description="depth range that counts as empty, as a share of the distance from a camera "
        "to the nearest point that it observes",
    )

    @hookimpl
    def crossgrad_final_edit(self, model: Model) -> FinalEdit | None:
        """Remove the floaters, unless all primitives would be removed."""
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
    """Return the line of the log about the removal of `count` primitives."""
    were = "primitive was" if count == 1 else "primitives were"
    return (
        f"floaters: {count:,} {were} removed from the empty space around training cameras, "
        "because no training photo shows them (--no-rule floaters keeps them)"
    )


def _primitives(model: Model) -> int:
    return len(model.parameters.get(model.backbone.positions, ()))


def floaters(model: Model, empty: float) -> Tensor:
    """Return [F] int64 indices of primitives in empty space that no training photo shows.

    A primitive that other primitives hide counts as shown. A primitive is a floater only if the
    rasterizer culls it in every training photo.

    Args:
        model: The model at the end of the run.
        empty: Radius of the empty space around a camera, as a share of the distance to the nearest
            point that the camera sees.
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
        # Render only the candidates, because a render of all Gaussians takes longer. The omitted
        # Gaussians do not matter, because hidden candidates count as shown.
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
    """Return the training views that observe enough points for an estimate of the empty space."""
    return [view for view in scene.train_views if len(view.seen) >= FEWEST_SEEN]


def in_empty_space(positions: NDArray[np.float64], scene: Scene, empty: float) -> NDArray[np.bool_]:
    """Return [N], True if a position is in the empty space around the nearest camera.

    Args:
        positions: [N, 3], local frame.
        scene: The scene, whose training cameras and observed SfM points bound the empty space.
        empty: Radius of the empty space around a camera, as a share of the distance to the nearest
            point that the camera sees.
    """
    # Import the k-d tree here, because SciPy's module loads slowly.
    from scipy.spatial import cKDTree

    views = cameras_that_tell(scene)
    if not views:
        return np.zeros(len(positions), dtype=np.bool_)
    depths = (view.camera.local(scene.points[view.seen])[:, 2] for view in views)
    nearest = np.array([np.percentile(view_depths, NEAREST) for view_depths in depths])
    reach = empty * np.maximum(nearest, 0.0)
    centers = np.stack([view.camera.center.numpy() for view in views])
    distance, which = cKDTree(centers).query(positions)
    return np.asarray(distance < reach[which])
