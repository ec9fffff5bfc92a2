"""Gaussians in the coordinates of a file whose numbers are too short for map coordinates."""

from dataclasses import dataclass
from math import floor, log10
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Rounding, Similarity, UserError, open_file
from crossgrad_plugins.exporters.ply_cloud import SplatCloud

#: Largest error of positions from rounding to float32, in local units.
POSITION_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class FileCloud:
    """Gaussians in the units of a file.

    Attributes:
        cloud: The Gaussians whose values are all finite, relative to `offset`.
        offset: [3] float64, added to the positions of `cloud` to get coordinates of the file.
        notes: Messages for the user, one sentence each.
    """

    cloud: SplatCloud
    offset: NDArray[np.float64]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, cloud: SplatCloud, similarity: Similarity, name: str = "") -> "FileCloud":
        """Return a cloud of the local frame in the units of the file `name`.

        Large coordinates (UTM, ECEF) can be too coarse in float32. If rounding would move Gaussians
        by more than 1e-6 local units, positions are relative to a rounded offset.
        """
        offset = position_offset(similarity)
        moved = cloud.to_input(Similarity(similarity.offset - offset, similarity.scale))
        valid, notes = representable(moved), []
        if not valid.all():
            moved = moved.selected(valid)
            notes.append(
                f"{name}: {np.sum(~valid):,} Gaussians left out, because they are not finite"
            )
        if offset.any():
            text = " ".join(plain_number(value) for value in offset)
            notes.append(
                f"{name}: coordinates are relative to {text}, because float32 is not precise enough"
            )
        return cls(moved, offset, tuple(notes))

    def relative(self, similarity: Similarity) -> Similarity:
        """Return the map of the frame of `similarity` to the numbers of the file."""
        return Similarity(similarity.offset - self.offset, similarity.scale)

    @property
    def float32_rounding(self) -> Rounding:
        """The rounding of positions to float32."""
        off = np.abs(self.cloud.means.astype(np.float32) - self.cloud.means)
        return Rounding(self.offset, float(off.max(initial=0.0)))


def position_offset(similarity: Similarity) -> NDArray[np.float64]:
    """Return [3] the offset to subtract from input coordinates before rounding to float32.

    The offset is zero unless rounding would move a Gaussian by more than `POSITION_TOLERANCE`.
    Otherwise the offset is the centre of the scene, rounded to a power of ten of at most one local
    unit.
    """
    largest = np.float32(np.abs(similarity.offset).max())
    error = 0.5 * float(np.spacing(largest)) * similarity.scale  # local units
    if error <= POSITION_TOLERANCE:
        return np.zeros(3)
    exponent = floor(log10(1.0 / similarity.scale))
    # Adding 0 avoids negative zeros
    offset: NDArray[np.float64] = np.round(similarity.offset, -exponent) + 0.0
    return offset


def plain_number(value: float) -> str:
    """Return a number without exponent or needless digits; float(text) gives the same bits."""
    return np.format_float_positional(value, trim="-")


def representable(cloud: SplatCloud) -> NDArray[np.bool_]:
    """Return [N] bool: Gaussians whose values are all finite in float32."""
    valid = (np.abs(cloud.means) <= np.finfo(np.float32).max).all(axis=1)
    valid &= np.isfinite(cloud.logit_opacities)
    for array in (cloud.log_scales, cloud.quats, cloud.sh_dc, cloud.sh_rest):
        valid &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
    return valid


def bytes_of(path: Path, most: int = -1) -> bytes:
    """Return the first `most` bytes of a file of Gaussians, or all bytes.

    Raises:
        UserError: The file cannot be read.
    """
    try:
        with open_file(path) as file:
            return file.read(most)
    except OSError as error:
        raise UserError(
            "the file of Gaussians cannot be read",
            where=path,
            found=error.strerror or str(error),
            todo="check the path and the permissions of the file",
        ) from error
