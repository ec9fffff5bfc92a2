"""Similarities between two frames of the world, known or fitted to points.

Source of the least-squares similarity: Umeyama 1991; of the search among triples by their median
residual: Rousseeuw 1984.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Maximum deviation of a rotation matrix whose digits were rounded. The matrix is made orthonormal
#: again.
_ROUNDED: Final = 1e-3
_EXACT: Final = 1e-12
_LAST_ROW: Final = np.array([0.0, 0.0, 0.0, 1.0])
#: Minimum number of points for a fit with a residual, and minimum number for rejecting outliers.
FEWEST, _FEWEST_TO_REJECT = 3, 8
#: Number of triples of points that are tried, maximum number of points per trial, and maximum
#: number of rejection passes.
_TRIPLES, _MOST_TRIED, _PASSES = 500, 100, 50
#: A residual is an outlier if it exceeds this many medians. If two axes have equal errors, one of
#: 10^5 normal errors exceeds this limit. If three axes have equal errors, fewer exceed it.
_FAR: Final = 4.0
#: Residuals below this share of the extent are rounding errors.
_ROUNDING: Final = 1e-9
#: Maximum standard error in radians of the rotation about the longest extent of the points.
_LARGEST_TILT: Final = np.radians(10.0)
#: Points count as collinear if their distance from a line is below this share of their extent, even
#: if the points are exact.
_THINNEST: Final = 1e-5


@dataclass(frozen=True, eq=False)
class Frame3D:
    """A similarity from one frame of the world to another: x' = scale * rotation x + shift.

    Attributes:
        rotation: [3, 3].
        shift: [3].
        scale: The scale, above zero.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float = 1.0

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points [N, 3]."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.shift)

    def after(self, first: "Frame3D") -> "Frame3D":
        """Return both similarities as one similarity: first `first`, then this similarity."""
        return Frame3D(
            self.rotation @ first.rotation,
            self.points(first.shift[None])[0],
            self.scale * first.scale,
        )

    @property
    def inverse(self) -> "Frame3D":
        """The similarity in the opposite direction."""
        turned = self.rotation.T
        return Frame3D(turned, -turned @ self.shift / self.scale, 1.0 / self.scale)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The similarity as a matrix [4, 4] for columns (x, y, z, 1)."""
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = self.scale * self.rotation, self.shift
        return whole


SAME: Final = Frame3D(np.eye(3), np.zeros(3))


def rotation_of(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return the rotation [3, 3] nearest to a matrix; None if the matrix is not a rotation.

    The matrix may deviate by the rounding of its digits. A matrix that is orthonormal in the
    precision of float64 is returned unchanged.
    """
    # Overflow and NaN also fail the test below.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not off <= _ROUNDED or np.linalg.det(matrix) < 0.0:
        return None
    if off <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def similarity_of(matrix: NDArray[np.float64]) -> Frame3D | None:
    """Return the similarity of a matrix [4, 4]; None if it stretches unevenly or mirrors."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 0.0 < scale < np.inf or np.abs(matrix[3] - _LAST_ROW).max() > 0.0:
        return None
    rotation = rotation_of(matrix[:3, :3] / scale)
    return None if rotation is None else Frame3D(rotation, matrix[:3, 3], scale)


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity fitted from points to measured points.

    Attributes:
        frame: The similarity.
        errors: [N, 3] measured minus fitted, in the frame of the measured points.
        kept: [N] bool, True for the points used in the fit.
        tilt: Standard error of the rotation about the longest extent of the points, radians.
    """

    frame: Frame3D
    errors: NDArray[np.float64]
    kept: NDArray[np.bool_]
    tilt: float


def fit_similarity(points: NDArray[np.float64], measured: NDArray[np.float64]) -> Fit | str:
    """Fit the similarity from points [N, 3] to measured points [N, 3], or return why it fails.

    The result is deterministic. With eight points or more, outliers are rejected, as long as more
    than half of the points agree.
    """
    if len(points) < FEWEST:
        return f"there are {len(points)} of them, but at least {FEWEST} are needed"
    kept = np.ones(len(points), dtype=bool)
    if len(points) >= _FEWEST_TO_REJECT:
        kept = _agreeing(points, measured)
    frame = _frame(points[kept], measured[kept])
    errors = measured - frame.points(points)
    # The similarity has seven parameters. Three points therefore leave two of their nine degrees of
    # freedom.
    sigma = float(np.sqrt((errors[kept] ** 2).sum() / (3 * int(kept.sum()) - 7)))
    posed = frame.scale * (points[kept] - points[kept].mean(axis=0))
    along, *across = np.linalg.svd(posed, compute_uv=False)
    width = float(np.hypot(*across))
    if not along > 0.0:
        return "they are all at the same position"
    tilt = sigma / width if width > _THINNEST * along else np.inf
    if tilt > _LARGEST_TILT:
        return "they are on a line, within their errors, so the rotation about it is unknown"
    return Fit(frame, errors, kept, tilt)


def _agreeing(points: NDArray[np.float64], measured: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the points [N], as bool, that agree with each other."""
    rng = np.random.default_rng(0)
    triples = np.argsort(rng.random((_TRIPLES, len(points))), axis=1)[:, :FEWEST]
    rotations, shifts, scales = _fitted(points[triples], measured[triples])
    subset = slice(None, None, -(-len(points) // _MOST_TRIED))
    fitted = scales[:, None, None] * (points[subset] @ rotations.transpose(0, 2, 1))
    tried = np.linalg.norm(measured[subset] - fitted - shifts[:, None], axis=2)  # [S, n]
    medians = np.median(tried, axis=1)
    best = int(np.argmin(medians))
    frame = Frame3D(rotations[best], shifts[best], float(scales[best]))
    least = _ROUNDING * float(np.abs(measured - measured.mean(axis=0)).max())
    # The new residuals have other rounding errors than before, but at least half of the points must
    # remain.
    half = max(float(medians[best]) * (1.0 + _ROUNDING), least)
    kept = np.linalg.norm(measured - frame.points(points), axis=1) <= half
    for _ in range(_PASSES):
        frame = _frame(points[kept], measured[kept])
        residuals = np.linalg.norm(measured - frame.points(points), axis=1)
        before, kept = kept, residuals <= max(_FAR * float(np.median(residuals)), least)
        if (before == kept).all():
            break
    return np.asarray(kept)


def _frame(points: NDArray[np.float64], measured: NDArray[np.float64]) -> Frame3D:
    """Return the least-squares similarity from points [N, 3] to measured points [N, 3]."""
    (rotation,), (shift,), (scale,) = _fitted(points[None], measured[None])
    return Frame3D(rotation, shift, float(scale))


def _fitted(
    points: NDArray[np.float64], measured: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit S sets of points [S, N, 3]; return rotations [S, 3, 3], shifts [S, 3] and scales [S]."""
    middle, aim = points.mean(axis=1), measured.mean(axis=1)
    source, target = points - middle[:, None], measured - aim[:, None]
    left, sizes, right = np.linalg.svd(target.transpose(0, 2, 1) @ source)
    # A mirrored solution is corrected along its shortest axis.
    signs = np.ones_like(sizes)
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    rotations = (left * signs[:, None]) @ right
    spread = (source**2).sum(axis=(1, 2))
    divisor = np.where(spread > 0.0, spread, 1.0)
    scales = (sizes * signs).sum(axis=1) / divisor
    shifts = aim - scales[:, None] * np.einsum("sij,sj->si", rotations, middle)
    return rotations, shifts, scales
