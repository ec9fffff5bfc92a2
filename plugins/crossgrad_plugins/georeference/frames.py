"""Similarities between two coordinate frames, known or fitted to points.

Source: Umeyama 1991 for the least-squares similarity; Rousseeuw 1984 for the search among triples
of points by their median residual.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Maximum deviation of a matrix from a rotation, because its digits may be rounded. The matrix is
#: then made orthonormal.
_ROUNDED: Final = 1e-3
_EXACT: Final = 1e-12
_LAST_ROW: Final = np.array([0.0, 0.0, 0.0, 1.0])
#: Minimum number of points for a fit with residuals, and minimum number for the rejection of
#: outliers.
FEWEST, _FEWEST_TO_REJECT = 3, 8
#: Number of tried triples of points, maximum number of points per trial, and maximum number of
#: passes that reject outliers.
_TRIPLES, _MOST_TRIED, _PASSES = 500, 100, 50
#: A point is an outlier if its residual is above this multiple of the median residual. If the
#: errors along two axes are equal, one of 10^5 normal errors is above this limit. If the errors
#: along three axes are equal, fewer errors are above it.
_FAR: Final = 4.0
#: Residuals below this share of the points' extent are rounding errors.
_ROUNDING: Final = 1e-9
#: Maximum standard error, in radians, of the rotation about the longest axis of the points.
_LARGEST_TILT: Final = np.radians(10.0)
#: Points count as collinear if their distances from a line are below this share of their extent.
_THINNEST: Final = 1e-5


@dataclass(frozen=True, eq=False)
class Frame3D:
    """A similarity between two coordinate frames: x' = scale * rotation x + shift.

    Attributes:
        rotation: [3, 3] rotation matrix.
        shift: [3] translation.
        scale: The scale factor, above zero.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float = 1.0

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points [N, 3]."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.shift)

    def after(self, first: "Frame3D") -> "Frame3D":
        """Return the similarity that applies `first` and then this similarity."""
        return Frame3D(
            self.rotation @ first.rotation,
            self.points(first.shift[None])[0],
            self.scale * first.scale,
        )

    @property
    def inverse(self) -> "Frame3D":
        """The inverse similarity."""
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

    The elements of the matrix may be rounded. A matrix that is orthonormal up to float64 rounding
    is returned unchanged.
    """
    # A matrix with infinite or NaN elements also fails this test.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not off <= _ROUNDED or np.linalg.det(matrix) < 0.0:
        return None
    if off <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def similarity_of(matrix: NDArray[np.float64]) -> Frame3D | None:
    """Return the similarity of a matrix [4, 4]; None if it mirrors or scales axes unequally."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 0.0 < scale < np.inf or np.abs(matrix[3] - _LAST_ROW).max() > 0.0:
        return None
    rotation = rotation_of(matrix[:3, :3] / scale)
    return None if rotation is None else Frame3D(rotation, matrix[:3, 3], scale)


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity that was fitted from points to measured points.

    Attributes:
        frame: The similarity.
        errors: [N, 3] measured minus fitted coordinates, in the frame of the measured points.
        kept: [N] bool, True for points that were used in the fit.
        tilt: Standard error of the rotation about the longest axis of the points, radians.
    """

    frame: Frame3D
    errors: NDArray[np.float64]
    kept: NDArray[np.bool_]
    tilt: float


def fit_similarity(points: NDArray[np.float64], measured: NDArray[np.float64]) -> Fit | str:
    """Fit the similarity from points [N, 3] to measured points [N, 3], or return why this fails.

    The result is deterministic. With eight points or more, outliers are rejected if more than half
    of the points agree with each other.
    """
    if len(points) < FEWEST:
        return f"there are {len(points)} of them, but at least {FEWEST} are needed"
    kept = np.ones(len(points), dtype=bool)
    if len(points) >= _FEWEST_TO_REJECT:
        kept = _agreeing(points, measured)
    frame = _frame(points[kept], measured[kept])
    errors = measured - frame.points(points)
    # A similarity has seven parameters. Three points have nine coordinates, so only two degrees of
    # freedom remain for the residuals.
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
    """Return [N] bool, True for points that agree with each other."""
    rng = np.random.default_rng(0)
    triples = np.argsort(rng.random((_TRIPLES, len(points))), axis=1)[:, :FEWEST]
    rotations, shifts, scales = _fitted(points[triples], measured[triples])
    subset = slice(None, None, -(-len(points) // _MOST_TRIED))
    fitted = scales[:, None, None] * (points[subset] @ rotations.transpose(0, 2, 1))
    tried = np.linalg.norm(measured[subset] - fitted - shifts[:, None], axis=2)
    medians = np.median(tried, axis=1)
    best = int(np.argmin(medians))
    frame = Frame3D(rotations[best], shifts[best], float(scales[best]))
    least = _ROUNDING * float(np.abs(measured - measured.mean(axis=0)).max())
    # Residuals change by rounding errors, but at least half of the points must stay.
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
    # If the solution is mirrored, flip its shortest axis.
    signs = np.ones_like(sizes)
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    rotations = (left * signs[:, None]) @ right
    spread = (source**2).sum(axis=(1, 2))
    divisor = np.where(spread > 0.0, spread, 1.0)
    scales = (sizes * signs).sum(axis=1) / divisor
    shifts = aim - scales[:, None] * np.einsum("sij,sj->si", rotations, middle)
    return rotations, shifts, scales
