"""Giants: Gaussians so large that a camera stands in them are made smaller while a run trains.

A splat is drawn as if its Gaussian were far away for its size (EWA). Of one that is as large as
its distance that is wrong: from a camera that has it at its side, at nearly right angles to its
axis, the splat covers the photo. Other photos, which have it before them, see in it a background
that they need, so that nothing holds it back (docs/floaters.md). The rule is ours.
"""

from math import log, sqrt
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.contract.topology import Edit, Rows
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.training.edits import apply_edit
from crossgrad_core.training.floaters import removes_floaters
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Steps from one look to the next; there is one after the last step, too.
EVERY: Final = 50
#: A giant has a standard deviation larger than this share of the extent of the training cameras,
#: from which published runs remove Gaussians after resets.
LARGE: Final = 0.1
#: Standard deviations within which an opaque Gaussian is drawn: alpha >= 1/255.
REACH: Final = sqrt(2.0 * log(255.0))
#: At once to no less than this share: a camera in the very middle says nothing of a size.
LEAST: Final = 0.02
#: What rounding leaves of `REACH` is near enough.
_NEARLY: Final = 1.0 - 1e-3
#: Giants that are looked at together.
_AT_ONCE: Final = 4096


def keep_off_cameras(setup: Setup, state: TrainState) -> bool:
    """Shrinks giants until no training camera is within `REACH` standard deviations of them.

    Where floaters stay (`--floaters keep`), giants do.

    Returns:
        Whether there were any.
    """
    names = setup.backbone.ellipsoids
    due = state.step % EVERY == 0 or state.step == setup.schedule.total
    if not due or not names or not removes_floaters(setup.config, setup.densifier):
        return False
    sizes, turns = (state.tensors[name].detach() for name in names)
    rows = (sizes.amax(dim=1) > log(LARGE)).nonzero().squeeze(1)
    if len(rows) == 0:
        return False
    means = state.tensors[setup.backbone.positions].detach()[rows].double()
    centers = torch.from_numpy(setup.scene.centers).to(means)
    parts = zip(
        torch.split(means, _AT_ONCE),
        torch.split(turns[rows].double(), _AT_ONCE),
        torch.split(sizes[rows].double().exp(), _AT_ONCE),
        strict=True,
    )
    away = torch.cat([nearest_camera(*part, centers) for part in parts])
    close = away < _NEARLY * REACH
    smaller = (away[close] / REACH).clamp(min=LEAST).log().to(sizes)
    if len(smaller) == 0:
        return False
    rows = rows[close]
    values = Rows(sizes[rows] + smaller[:, None], rows, keep_moments=True)
    apply_edit(setup, state, Edit(values={names[0]: values}))
    return True


def nearest_camera(means: Tensor, quats: Tensor, scales: Tensor, centers: Tensor) -> Tensor:
    """[N] how many standard deviations the nearest of the centres is away from each Gaussian.

    Args:
        means: [N, 3].
        quats: [N, 4] wxyz, need not be normalised.
        scales: [N, 3] standard deviations.
        centers: [C, 3].
    """
    own = (centers - means[:, None]) @ rotation_matrices(quats)
    away: Tensor = torch.linalg.vector_norm(own / scales[:, None], dim=2)
    return away.amin(dim=1)
