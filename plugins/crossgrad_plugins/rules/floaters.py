"""Floaters: primitives around a camera that no training photo shows, removed at the end of a run.

A step may carry a Gaussian past the camera that it is seen from, or out at the side of its photo.
No photo pulls at it any more, so that it stays as it is, and if it is opaque it hides all that a
photo from nearby would show (docs/floaters.md). The rule is ours.
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

#: The percentile of the depths of its SfM points that counts as nearest: single points lie wrong.
NEAREST: Final = 1.0
#: Cameras that observe fewer points say nothing about what is empty.
FEWEST_SEEN: Final = 8


class Floaters(Rule):
    """Removes primitives around cameras that no training photo shows, when a run is finished."""

    empty: float = Field(
        0.3,
        gt=0,
        le=1,
        # The ground below a level camera, which sees it from some way off on, is farther away.
        description="share of the distance from a camera to the nearest point it sees that counts "
        "as empty",
    )

    @hookimpl
    def crossgrad_final_edit(self, model: Model) -> FinalEdit | None:
        """Remove the floaters, unless nothing else would be left."""
        count, rows = _primitives(model), floaters(model, self.empty)
        if not 0 < len(rows) < count:
            return None
        kept = torch.ones(count, dtype=torch.bool, device=rows.device)
        kept[rows] = False
        return FinalEdit(Edit(kept.nonzero().squeeze(1)), removed(len(rows)))

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        if not backbone.positions:
            return "the backbone names no positions"
        if not cameras_that_tell(scene):
            return "no photo observes enough points to say what around it is empty"
        return ""


def removed(count: int) -> str:
    """Return the line of the log about the removal of so many primitives."""
    were = "primitive was" if count == 1 else "primitives were"
    return (
        f"floaters: {count:,} {were} removed that no training photo shows, in the empty space "
        "around its cameras (--no-rule floaters: they stay)"
    )


def _primitives(model: Model) -> int:
    return len(model.parameters.get(model.backbone.positions, ()))


def floaters(model: Model, empty: float) -> Tensor:
    """[F] int64: the primitives in the empty space around a camera that touch no training photo.

    A hidden primitive counts as touched: only one that the rasterizer leaves out of every photo
    floats.

    Args:
        model: The model at the end of the run.
        empty: See `in_empty_space`.
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
        # Alone they are drawn in no time, and what would hide them does not matter.
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
    """The training views that observe enough points to say how far the empty space goes."""
    return [view for view in scene.train_views if len(view.seen) >= FEWEST_SEEN]


def in_empty_space(positions: NDArray[np.float64], scene: Scene, empty: float) -> NDArray[np.bool_]:
    """[N]: whether each position lies in the space that the nearest camera shows to be empty.

    Args:
        positions: [N, 3], local frame.
        scene: Its training cameras and their SfM points count.
        empty: Share of the way from a camera to the nearest point that it sees.
    """
    from scipy.spatial import cKDTree  # Slow to import.

    views = cameras_that_tell(scene)
    if not views:
        return np.zeros(len(positions), dtype=np.bool_)
    depths = (view.camera.local(scene.points[view.seen])[:, 2] for view in views)
    nearest = np.array([np.percentile(each, NEAREST) for each in depths])
    reach = empty * np.maximum(nearest, 0.0)
    centers = np.stack([view.camera.center.numpy() for view in views])
    distance, which = cKDTree(centers).query(positions)
    return np.asarray(distance < reach[which])
