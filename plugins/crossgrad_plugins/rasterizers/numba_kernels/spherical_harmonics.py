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

#: Number of basis functions of all degrees.
BASIS = 16
#: Floats of a cache line, and records ahead for whose coefficients memory is asked.
_LINE, _AHEAD = 16, 6

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
def _basis(degree: int, x: float, y: float, z: float, basis: NDArray[np.float64]) -> None:
    """Writes the basis functions of degrees 0 to `degree` for a unit direction."""
    basis[0] = _C0
    if degree < 1:
        return
    basis[1] = -_C1 * y
    basis[2] = _C1 * z
    basis[3] = -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = _C2_XY * x * y
    basis[5] = -_C2_XY * y * z
    basis[6] = _C2_ZZ * (2.0 * zz - xx - yy)
    basis[7] = -_C2_XY * x * z
    basis[8] = _C2_XX * (xx - yy)
    if degree < 3:
        return
    basis[9] = -_C3_XXX * y * (3.0 * xx - yy)
    basis[10] = _C3_XYZ * x * y * z
    basis[11] = -_C3_XZZ * y * (4.0 * zz - xx - yy)
    basis[12] = _C3_ZZZ * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    basis[13] = -_C3_XZZ * x * (4.0 * zz - xx - yy)
    basis[14] = _C3_XXZ * z * (xx - yy)
    basis[15] = -_C3_XXX * x * (xx - 3.0 * yy)


@device
def _direction_gradient(
    degree: int, x: float, y: float, z: float, v: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Returns the gradient of sum(v * basis) by x, y and z, taken as independent."""
    if degree < 1:
        return 0.0, 0.0, 0.0
    v_x, v_y, v_z = -_C1 * v[3], -_C1 * v[1], _C1 * v[2]
    if degree < 2:
        return v_x, v_y, v_z
    a, b, c, d = _C2_XY * v[4], -_C2_XY * v[5], -_C2_XY * v[7], 2.0 * _C2_XX * v[8]
    e = 2.0 * _C2_ZZ * v[6]
    v_x += a * y + c * z + d * x - e * x
    v_y += a * x + b * z - d * y - e * y
    v_z += b * y + c * x + 2.0 * e * z
    if degree < 3:
        return v_x, v_y, v_z
    xx, yy, zz = x * x, y * y, z * z
    f, g, h = -_C3_XXX * v[9], _C3_XYZ * v[10], -_C3_XZZ * v[11]
    k, m, n = _C3_ZZZ * v[12], -_C3_XZZ * v[13], _C3_XXZ * v[14]
    p = -_C3_XXX * v[15]
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
    basis = np.empty(BASIS, np.float64)
    chunk = take(jobs)
    while chunk < drawn.shape[0]:
        end = chunk * CHUNK + drawn[chunk]
        for j in range(chunk * CHUNK, end):
            i = np.intp(owners[j])
            _bring_near(rest, np.intp(owners[min(j + _AHEAD, end - 1)]))
            x, y, z, _ = _direction(means, i, eye)
            _basis(degree, x, y, z, basis)
            red = 0.5 + basis[0] * np.float64(dc[i, 0, 0])
            green = 0.5 + basis[0] * np.float64(dc[i, 0, 1])
            blue = 0.5 + basis[0] * np.float64(dc[i, 0, 2])
            # Coefficients in the order of memory; three sums that do not wait for each other.
            for k in range(1, count):
                red += basis[k] * np.float64(rest[i, k - 1, 0])
                green += basis[k] * np.float64(rest[i, k - 1, 1])
                blue += basis[k] * np.float64(rest[i, k - 1, 2])
            for channel, colour in enumerate((red, green, blue)):
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
        rows: Whether `v_dc` and `v_rest` have a row for each record instead, in their order.
    """
    dc_by_rows, rest_by_rows = rows
    count = (degree + 1) * (degree + 1)
    basis = np.empty(BASIS, np.float64)
    v_basis = np.empty(BASIS, np.float64)
    chunk = take(jobs)
    while chunk < drawn.shape[0]:
        before = drawn[:chunk].sum() - chunk * CHUNK
        end = chunk * CHUNK + drawn[chunk]
        for j in range(chunk * CHUNK, end):
            if records[j * RECORD + LOG_OPACITY] == -math.inf:
                continue
            i = np.intp(owners[j])
            _bring_near(rest, np.intp(owners[min(j + _AHEAD, end - 1)]))
            to_dc = before + j if dc_by_rows else i
            to_rest = before + j if rest_by_rows else i
            x, y, z, inverse = _direction(means, i, eye)
            _basis(degree, x, y, z, basis)
            at = j * RECORD + RED
            if min(records[at], records[at + 1], records[at + 2]) > np.float32(0.0):
                red, green = np.float64(v_colors[i, 0]), np.float64(v_colors[i, 1])
                blue = np.float64(v_colors[i, 2])
                v_dc[to_dc, 0, 0] = red * basis[0]
                v_dc[to_dc, 0, 1] = green * basis[0]
                v_dc[to_dc, 0, 2] = blue * basis[0]
                # Coefficients in the order of memory.
                for k in range(1, count):
                    v_rest[to_rest, k - 1, 0] = red * basis[k]
                    v_rest[to_rest, k - 1, 1] = green * basis[k]
                    v_rest[to_rest, k - 1, 2] = blue * basis[k]
                    along = red * np.float64(rest[i, k - 1, 0])
                    along += green * np.float64(rest[i, k - 1, 1])
                    v_basis[k] = along + blue * np.float64(rest[i, k - 1, 2])
            else:
                v_basis[:] = 0.0
                for channel in range(3):
                    # A channel clamped at 0 has no gradient.
                    if records[at + channel] <= np.float32(0.0):
                        continue
                    v = np.float64(v_colors[i, channel])
                    v_dc[to_dc, 0, channel] = v * basis[0]
                    for k in range(1, count):
                        v_rest[to_rest, k - 1, channel] = v * basis[k]
                        v_basis[k] += v * np.float64(rest[i, k - 1, channel])
            v_x, v_y, v_z = _direction_gradient(degree, x, y, z, v_basis)
            along = x * v_x + y * v_y + z * v_z
            v_means[i, 0] += (v_x - x * along) * inverse
            v_means[i, 1] += (v_y - y * along) * inverse
            v_means[i, 2] += (v_z - z * along) * inverse
        chunk = take(jobs)
