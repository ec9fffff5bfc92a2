"""Floaters: primitives around a camera that no training photo shows, removed at the end of a run.

A step may carry a Gaussian past the camera that it is seen from, or out at the side of its photo.
No photo pulls at it any more, so that it stays what it is, and opaque it hides all that a photo
from nearby would show (docs/floaters.md). The rule is ours.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import Edit, apply_to_parameters
from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.training.averaging import eval_parameters
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Around a camera this share of the distance to the nearest point that it sees is taken to be
#: empty. The ground below a level camera, which sees it from some way off on, is farther away.
EMPTY: Final = 0.3
#: The percentile of the depths of its SfM points that counts as nearest: single points lie wrong.
NEAREST: Final = 1.0
#: Cameras that observe fewer points say nothing about what is empty.
FEWEST_SEEN: Final = 8


def told_of(count: int) -> str:
    """What to say where so many were removed."""
    were = "primitive was" if count == 1 else "primitives were"
    return (
        f"floaters: {count:,} {were} removed that no training photo shows, in the empty space "
        "around its cameras (--floaters keep: they stay)"
    )


def rows_without_floaters(setup: Setup, state: TrainState, empty: float = EMPTY) -> Tensor | None:
    """[M] int64: the primitives that are no floaters; None where all stay.

    All stay, too, where nothing else would be left. Arguments as of `floaters`.
    """
    rows = floaters(setup, state, empty)
    kept = torch.ones(state.primitives(setup), dtype=torch.bool, device=setup.device)
    if not 0 < len(rows) < len(kept):
        return None
    kept[rows] = False
    return kept.nonzero().squeeze(1)


def floaters(setup: Setup, state: TrainState, empty: float = EMPTY) -> Tensor:
    """[F] int64: the primitives in the empty space around a camera that touch no training photo.

    What is hidden counts as touched: only what the rasterizer leaves out of every photo floats.

    Args:
        setup: The run.
        state: Its state.
        empty: See `in_empty_space`.
    """
    parameters = eval_parameters(state)
    name = setup.backbone.positions
    if name not in parameters:
        return torch.zeros(0, dtype=torch.int64, device=setup.device)
    positions = parameters[name].detach().double().cpu().numpy()
    near = in_empty_space(positions, setup.scene, empty)
    rows = torch.from_numpy(np.flatnonzero(near)).to(setup.device)
    phase = setup.phase(state.step, training=False)
    background = torch.zeros(3, device=setup.device)
    for view in setup.train_views:
        if len(rows) == 0:
            break
        # Alone they are drawn in no time, and what would hide them does not matter.
        alone = apply_to_parameters(Edit(rows), setup.blocks, parameters)
        with torch.no_grad():
            gaussians = setup.backbone.decode(alone, view.camera, phase)
            drawn = setup.rasterizer.render(gaussians, view.camera, background).screen.radii > 0
        origin, untouched = gaussians.origin, torch.ones_like(rows, dtype=torch.bool)
        untouched[drawn if origin is None else origin[drawn]] = False
        rows = rows[untouched]
    return rows


def cameras_that_tell(scene: Scene) -> list[View]:
    """The training views that observe enough points to say how far the empty space goes."""
    return [view for view in scene.train_views if len(view.seen) >= FEWEST_SEEN]


def in_empty_space(
    positions: NDArray[np.float64], scene: Scene, empty: float = EMPTY
) -> NDArray[np.bool_]:
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
