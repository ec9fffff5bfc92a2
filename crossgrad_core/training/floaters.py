"""Floaters: primitives before a camera that no training photo shows, removed at the end of a run.

A step may carry a Gaussian past the camera that it is seen from, or out at the side of its photo.
No photo pulls at it any more, so that it stays what it is, and opaque it hides all that a photo
from nearby would show (docs/floaters.md). The rule is ours.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.topology import Edit, apply_to_parameters
from crossgrad_core.training.clock import Laps
from crossgrad_core.training.edits import keep
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.steady import shown, with_rows

#: Around a camera this share of the distance to the nearest that it sees is taken to be empty.
EMPTY: Final = 0.5
#: The percentile of the depths of its SfM points that counts as nearest: single points lie wrong.
NEAREST: Final = 1.0
#: Cameras that observe fewer points say nothing about what is empty.
FEWEST_SEEN: Final = 8


def removes_floaters(config: RunConfig, densifier: Densifier) -> bool:
    """Whether a run removes them: by default where the set of primitives may change at all."""
    if config.floaters is not None:
        return config.floaters == "remove"
    return config.preset != "inria" and densifier.edits


def remove_floaters(setup: Setup, state: TrainState, empty: float = EMPTY) -> int:
    """Removes the floaters of a trained model, on the training clock; no training photo changes.

    Args:
        setup: The run.
        state: Its state after the last step.
        empty: See `in_empty_space`.

    Returns:
        How many were removed: none where nothing would be left.
    """
    state.laps = Laps()
    kept = torch.ones(state.primitives(setup), dtype=torch.bool, device=setup.device)
    kept[floaters(setup, state, empty)] = False
    rows = kept.nonzero().squeeze(1)
    count = len(kept) - len(rows)
    if 0 < count < len(kept):
        with_rows(setup, state, rows)
        keep(setup, state, rows)
    state.laps.lap("density_control")
    state.clock.count(state.laps)
    return count if len(rows) else 0


def told_of(count: int) -> str:
    """What to say where so many were removed."""
    were = "primitive was" if count == 1 else "primitives were"
    return (
        f"floaters: {count:,} {were} removed that no training photo shows, in the empty space "
        "before its cameras (--floaters keep: they stay)"
    )


def floaters(setup: Setup, state: TrainState, empty: float = EMPTY) -> Tensor:
    """[F] int64: the primitives in the empty space before a camera that touch no training photo.

    What is hidden counts as touched: only what the rasterizer leaves out of every photo floats.
    """
    parameters, none = shown(state), torch.zeros(0, dtype=torch.int64, device=setup.device)
    name = setup.backbone.positions
    if name not in parameters:
        return none
    positions = parameters[name].detach().double().cpu().numpy()
    near = np.flatnonzero(in_empty_space(positions, setup.scene, empty))
    if len(near) == 0:
        return none
    rows = torch.from_numpy(near).to(setup.device)
    # Alone they are drawn in no time, and what would hide them does not matter.
    alone = apply_to_parameters(Edit(rows), setup.blocks, parameters)
    return rows[~_touched(setup, state, alone, len(rows))]


def in_empty_space(
    positions: NDArray[np.float64], scene: Scene, empty: float = EMPTY
) -> NDArray[np.bool_]:
    """[N]: whether each position lies in the space that the nearest camera shows to be empty.

    Args:
        positions: [N, 3], local frame.
        scene: Its training cameras and their SfM points count.
        empty: Share of the way from a camera to the nearest that it sees.
    """
    from scipy.spatial import cKDTree  # Slow to import.

    cameras = [view for view in scene.train_views if len(view.seen) >= FEWEST_SEEN]
    if not cameras:
        return np.zeros(len(positions), dtype=np.bool_)
    depths = (view.camera.local(scene.points[view.seen])[:, 2] for view in cameras)
    reach = np.array([empty * np.percentile(each, NEAREST) for each in depths])
    centers = np.stack([view.camera.center.numpy() for view in cameras])
    distance, nearest = cKDTree(centers).query(positions)
    return np.asarray(distance < reach[nearest])


def _touched(setup: Setup, state: TrainState, alone: Parameters, count: int) -> Tensor:
    """[P] bool: which of these primitives touch a pixel of some training photo."""
    touched = torch.zeros(count, dtype=torch.bool, device=setup.device)
    phase = setup.phase(state.step, training=False)
    background = torch.zeros(3, device=setup.device)
    with torch.no_grad():
        for view in setup.train_views:
            gaussians = setup.backbone.decode(alone, view.camera, phase)
            radii = setup.rasterizer.render(gaussians, view.camera, background).screen.radii
            origin = gaussians.origin
            touched[radii > 0 if origin is None else origin[radii > 0]] = True
    return touched
