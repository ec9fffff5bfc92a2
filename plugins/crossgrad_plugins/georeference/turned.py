"""Gaussians that are turned as a whole, with the colours that they show to each side."""

from dataclasses import replace
from functools import cache

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from crossgrad_core.numerics.spherical import COEFFICIENTS
from crossgrad_core.plugin import Gaussians
from crossgrad_plugins.rasterizers.reference.harmonics import harmonics

#: Directions in which the harmonics of a turned frame are compared; more than twice as many as
#: there are harmonics.
_DIRECTIONS = 48


def turned(gaussians: Gaussians, means: Tensor, rotation: Tensor) -> Gaussians:
    """Gaussians about other centres [N, 3], each turned by one rotation [3, 3] float64.

    A camera that is turned alike sees what it saw before.
    """
    x, y, z, w = Rotation.from_matrix(rotation.cpu().numpy()).as_quat().tolist()
    quats = _product((w, x, y, z), gaussians.quats)
    rest = gaussians.sh_rest
    if rest is not None:
        degree = COEFFICIENTS.index(1 + rest.shape[1])
        rest = _harmonics_turn(rotation, degree).to(rest) @ rest
    return replace(gaussians, means=means, quats=quats, sh_rest=rest)


def _product(first: tuple[float, ...], second: Tensor) -> Tensor:
    """The quaternions [N, 4] wxyz of a turn by `second` [N, 4], then by `first`."""
    w, x, y, z = first
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return second @ torch.tensor(rows, dtype=torch.float64).T.to(second)


def _harmonics_turn(rotation: Tensor, degree: int) -> Tensor:
    """[B, B] float64, what turns coefficients of bands 1 to `degree` (B of them).

    Harmonics of a turned direction are linear in those of the direction, with an orthogonal matrix
    for each band; it is told by their values in enough directions.
    """
    directions = _directions()
    before, after = (harmonics(each, degree)[:, 1:] for each in (directions, directions @ rotation))
    found: Tensor = torch.linalg.lstsq(before, after).solution
    return found


@cache
def _directions() -> Tensor:
    """[48, 3] float64 unit vectors all around."""
    drawn = torch.randn((_DIRECTIONS, 3), generator=torch.Generator().manual_seed(0)).double()
    unit: Tensor = drawn / drawn.norm(dim=1, keepdim=True)
    return unit
