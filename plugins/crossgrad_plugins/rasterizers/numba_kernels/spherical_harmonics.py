"""View-dependent colour by real spherical harmonics up to degree 3 (signs and order of 3DGS)."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, take
from crossgrad_core.numerics.simd import prefetch
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    CHUNK,
    LOG_OPACITY,
    RECORD,
    RED,
)
from crossgrad_plugins.rasterizers.numba_kernels.third_degree import (
    BASIS,
    FLOATS,
    HIGHER,
    pull,
    sum_up,
)

#: Floats of a cache line.
_LINE = 16
#: Gaussians whose basis functions are worked out, and whose coefficients are brought near, before
#: any of them is used; and what there is of each: direction and inverse distance.
_BLOCK, _WAY = 32, 4

_C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
_C2_XY = 1.0925484305920792  # sqrt(15 / (4 pi))
_C2_ZZ = 0.31539156525252005  # sqrt(5 / (16 pi))
_C2_XX = 0.5462742152960396  # sqrt(15 / (16 pi))
_C3_XXX = 0.5900435899266435  # sqrt(35 / (32 pi))
_C3_XYZ = 2.890611442640554  # sqrt(105 / (4 pi))
_C3_XZZ = 0.4570457994644658  # sqrt(21 / (32 pi))
_C3_ZZZ = 0.3731763325901154  # sqrt(7 / (16 pi))
_C3_XXZ = 1.445305721320277  # sqrt(105 / (16 pi))


@device
def _direction(
    means: NDArray[np.float32], i: int, eye: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    """Returns the unit vector from the camera to Gaussian i, and the inverse distance."""
    x = np.float64(means[i, 0]) - eye[0]
    y = np.float64(means[i, 1]) - eye[1]
    z = np.float64(means[i, 2]) - eye[2]
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse, inverse


@device
def _bring_near(rest: NDArray[np.float32], i: int) -> None:
    """Asks for the memory of the coefficients of Gaussian i before they are needed."""
    width = 3 * rest.shape[1]
    for at in range(0, width, _LINE):
        prefetch(rest, i * width + at)


@device
def _basis(degree: int, x: float, y: float, z: float, bases: NDArray[np.float32], row: int) -> None:
    """Writes the basis functions of degrees 0 to `degree` for a unit direction to bases[row:]."""
    bases[row] = _C0
    if degree < 1:
        return
    bases[row + 1] = -_C1 * y
    bases[row + 2] = _C1 * z
    bases[row + 3] = -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    bases[row + 4] = _C2_XY * x * y
    bases[row + 5] = -_C2_XY * y * z
    bases[row + 6] = _C2_ZZ * (2.0 * zz - xx - yy)
    bases[row + 7] = -_C2_XY * x * z
    bases[row + 8] = _C2_XX * (xx - yy)
    if degree < 3:
        return
    bases[row + 9] = -_C3_XXX * y * (3.0 * xx - yy)
    bases[row + 10] = _C3_XYZ * x * y * z
    bases[row + 11] = -_C3_XZZ * y * (4.0 * zz - xx - yy)
    bases[row + 12] = _C3_ZZZ * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    bases[row + 13] = -_C3_XZZ * x * (4.0 * zz - xx - yy)
    bases[row + 14] = _C3_XXZ * z * (xx - yy)
    bases[row + 15] = -_C3_XXX * x * (xx - 3.0 * yy)


@device
def _direction_gradient(
    degree: int, x: float, y: float, z: float, v: NDArray[np.float32], at: int
) -> tuple[float, float, float]:
    """Returns the gradient of sum(v * basis) by x, y and z, taken as independent.

    Those of degree 1 and higher are v[at + 1] and so on.
    """
    if degree < 1:
        return 0.0, 0.0, 0.0
    v_x, v_y, v_z = -_C1 * v[at + 3], -_C1 * v[at + 1], _C1 * v[at + 2]
    if degree < 2:
        return v_x, v_y, v_z
    a, b, c = _C2_XY * v[at + 4], -_C2_XY * v[at + 5], -_C2_XY * v[at + 7]
    d, e = 2.0 * _C2_XX * v[at + 8], 2.0 * _C2_ZZ * v[at + 6]
    v_x += a * y + c * z + d * x - e * x
    v_y += a * x + b * z - d * y - e * y
    v_z += b * y + c * x + 2.0 * e * z
    if degree < 3:
        return v_x, v_y, v_z
    xx, yy, zz = x * x, y * y, z * z
    f, g, h = -_C3_XXX * v[at + 9], _C3_XYZ * v[at + 10], -_C3_XZZ * v[at + 11]
    k, m, n = _C3_ZZZ * v[at + 12], -_C3_XZZ * v[at + 13], _C3_XXZ * v[at + 14]
    p = -_C3_XXX * v[at + 15]
    v_x += f * 6.0 * x * y + g * y * z - h * 2.0 * x * y - k * 6.0 * x * z
    v_x += m * (4.0 * zz - 3.0 * xx - yy) + n * 2.0 * x * z + p * 3.0 * (xx - yy)
    v_y += f * 3.0 * (xx - yy) + g * x * z + h * (4.0 * zz - xx - 3.0 * yy) - k * 6.0 * y * z
    v_y += -m * 2.0 * x * y - n * 2.0 * y * z - p * 6.0 * x * y
    v_z += g * x * y + h * 8.0 * y * z + k * (6.0 * zz - 3.0 * xx - 3.0 * yy)
    v_z += m * 8.0 * x * z + n * (xx - yy)
    return v_x, v_y, v_z


@kernel
def shade(
    jobs: Jobs,
    degree: int,
    eye: NDArray[np.float64],
    means: NDArray[np.float32],
    dc: NDArray[np.float32],
    rest: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    records: NDArray[np.float32],
    radii: NDArray[np.int32],
) -> None:
    """Writes max(0, 1/2 + harmonics(direction)) to the colours of the records.

    Args:
        jobs: From `share`.
        degree: Active degree, 0 to 3.
        eye: [3] camera centre.
        means: [N, 3].
        dc: [N, 1, 3] coefficients of degree 0.
        rest: [N, B - 1, 3] of the higher degrees; only those active are read.
        drawn: [chunks] from `project`.
        owners: [N] from `project`.
        records: Flat records, colours written; a colour that is not finite draws nothing.
        radii: [N] set to 0 for these.
    """
    count = (degree + 1) * (degree + 1)
    whole = count == BASIS and rest.shape[1] == HIGHER
    bases = np.zeros(_BLOCK * BASIS, np.float32)
    colours = np.empty(_BLOCK * BASIS, np.float32)
    chunk = take(jobs)
    while chunk < drawn.shape[0]:
        end = chunk * CHUNK + drawn[chunk]
        for first in range(chunk * CHUNK, end, _BLOCK):
            last = min(first + _BLOCK, end)
            for j in range(first, last):
                i = np.intp(owners[j])
                _bring_near(rest, i)
                x, y, z, _ = _direction(means, i, eye)
                _basis(degree, x, y, z, bases, (j - first) * BASIS)
            for j in range(first, last):
                i, row = np.intp(owners[j]), (j - first) * BASIS
                if whole:
                    sum_up(bases, row, rest, i * FLOATS, colours)
                    continue
                colours[row : row + 3] = np.float32(0.0)
                for k in range(1, count):
                    for channel in range(3):
                        colours[row + channel] += bases[row + k] * rest[i, k - 1, channel]
            for j in range(first, last):
                i, row = np.intp(owners[j]), (j - first) * BASIS
                for channel in range(3):
                    colour = 0.5 + _C0 * np.float64(dc[i, 0, channel])
                    colour += np.float64(colours[row + channel])
                    if not math.isfinite(colour):
                        # Reaches no pixel.
                        records[j * RECORD + LOG_OPACITY] = -math.inf
                        radii[i] = 0
                    records[j * RECORD + RED + channel] = max(colour, 0.0)
        chunk = take(jobs)


@kernel
def unshade(
    jobs: Jobs,
    degree: int,
    eye: NDArray[np.float64],
    means: NDArray[np.float32],
    rest: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    records: NDArray[np.float32],
    v_colors: NDArray[np.float32],
    v_dc: NDArray[np.float32],
    v_rest: NDArray[np.float32],
    v_means: NDArray[np.float32],
    rows: tuple[bool, bool],
) -> None:
    """Carries gradients of the colours on to coefficients and centres.

    Args:
        jobs: From `share`.
        degree: As in `shade`, like the next six.
        eye: [3].
        means: [N, 3].
        rest: [N, B - 1, 3].
        drawn: [chunks].
        owners: [N].
        records: Flat records.
        v_colors: [N, 3] gradients of the clamped colours.
        v_dc: [N, 1, 3] written for the Gaussians drawn; zero before.
        v_rest: [N, B - 1, 3] likewise, active degrees only.
        v_means: [N, 3] added to.
        rows: Whether `v_dc` and `v_rest` have a row for each record instead, in their order; such
            rows are written whole, and need not be zero before.
    """
    dc_by_rows, rest_by_rows = rows
    count = (degree + 1) * (degree + 1)
    whole = count == BASIS and rest.shape[1] == HIGHER
    bases = np.zeros(_BLOCK * BASIS, np.float32)
    pulls = np.zeros(_BLOCK * BASIS, np.float32)
    v_bases = np.zeros(_BLOCK * BASIS, np.float32)
    ways = np.empty(_BLOCK * _WAY, np.float64)
    chunk = take(jobs)
    while chunk < drawn.shape[0]:
        before = drawn[:chunk].sum() - chunk * CHUNK
        end = chunk * CHUNK + drawn[chunk]
        for first in range(chunk * CHUNK, end, _BLOCK):
            last = min(first + _BLOCK, end)
            for j in range(first, last):
                i, row, way = np.intp(owners[j]), (j - first) * BASIS, (j - first) * _WAY
                _bring_near(rest, i)
                ways[way], ways[way + 1], ways[way + 2], ways[way + 3] = _direction(means, i, eye)
                _basis(degree, ways[way], ways[way + 1], ways[way + 2], bases, row)
                to_dc = before + j if dc_by_rows else i
                seen = records[j * RECORD + LOG_OPACITY] > -math.inf
                for channel in range(3):
                    # A channel clamped at 0 has no gradient.
                    free = seen and records[j * RECORD + RED + channel] > np.float32(0.0)
                    v = v_colors[i, channel] if free else np.float32(0.0)
                    pulls[row + channel] = v
                    v_dc[to_dc, 0, channel] = _C0 * np.float64(v)
            for j in range(first, last):
                i, row = np.intp(owners[j]), (j - first) * BASIS
                to_rest = before + j if rest_by_rows else i
                if whole:
                    to = to_rest * FLOATS
                    pull(bases, row, pulls, rest, i * FLOATS, v_rest, to, v_bases)
                    continue
                if rest_by_rows:
                    v_rest[to_rest] = np.float32(0.0)
                for k in range(1, count):
                    along = np.float32(0.0)
                    for channel in range(3):
                        v_rest[to_rest, k - 1, channel] = pulls[row + channel] * bases[row + k]
                        along += pulls[row + channel] * rest[i, k - 1, channel]
                    v_bases[row + k - 1] = along
            for j in range(first, last):
                if records[j * RECORD + LOG_OPACITY] == -math.inf:
                    continue
                i, row, way = np.intp(owners[j]), (j - first) * BASIS, (j - first) * _WAY
                x, y, z, inverse = ways[way], ways[way + 1], ways[way + 2], ways[way + 3]
                v_x, v_y, v_z = _direction_gradient(degree, x, y, z, v_bases, row - 1)
                along = x * v_x + y * v_y + z * v_z
                v_means[i, 0] += (v_x - x * along) * inverse
                v_means[i, 1] += (v_y - y * along) * inverse
                v_means[i, 2] += (v_z - z * along) * inverse
        chunk = take(jobs)
