"""Similarities from one frame of the world to another, known or fitted to points.

Source of the least-squares similarity: Umeyama 1991; of the search among triples by their median
residual: Rousseeuw 1984.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: What a rotation may be off by where its digits were rounded; it is made orthonormal again.
_ROUNDED: Final = 1e-3
_EXACT: Final = 1e-12
_LAST_ROW: Final = np.array([0.0, 0.0, 0.0, 1.0])
#: Fewer than these leave none to compare with; none of so few is rejected.
FEWEST, _FEWEST_TO_REJECT = 3, 8
#: Triples that are tried, on how many of the points at most, and passes of leaving out.
_TRIPLES, _MOST_TRIED, _PASSES = 500, 100, 50
#: Residuals beyond so many medians are wrong; of normal errors one in 10^5 is where two axes have
#: them alike, and fewer where three do.
_FAR: Final = 4.0
#: Share of the extent that is rounding, not error.
_ROUNDING: Final = 1e-9
#: Radians by which the whole may turn about its longest extent, standard error.
_LARGEST_TILT: Final = np.radians(10.0)
#: A hundred times closer to a line than that is on it, however exact the measurements.
_THINNEST: Final = 1e-5


@dataclass(frozen=True, eq=False)
class Frame3D:
    """A similarity from one frame of the world to another: x' = scale * rotation x + shift.

    Attributes:
        rotation: [3, 3].
        shift: [3].
        scale: Above zero.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float = 1.0

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] points."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.shift)

    def after(self, first: "Frame3D") -> "Frame3D":
        """Both similarities in one: `first`, then this one."""
        return Frame3D(
            self.rotation @ first.rotation,
            self.points(first.shift[None])[0],
            self.scale * first.scale,
        )

    @property
    def inverse(self) -> "Frame3D":
        """The way from the other frame to the one."""
        turned = self.rotation.T
        return Frame3D(turned, -turned @ self.shift / self.scale, 1.0 / self.scale)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[4, 4], for columns (x, y, z, 1)."""
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = self.scale * self.rotation, self.shift
        return whole


SAME: Final = Frame3D(np.eye(3), np.zeros(3))


def rotation_of(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The rotation [3, 3] that a matrix is, up to the rounding of its digits; None if it is none.

    A matrix that is orthonormal to float64 comes back as it is.
    """
    # What overflows is off as well, and so is what is not a number.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not off <= _ROUNDED or np.linalg.det(matrix) < 0.0:
        return None
    if off <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def similarity_of(matrix: NDArray[np.float64]) -> Frame3D | None:
    """The similarity that a matrix [4, 4] is; None where it stretches unevenly or mirrors."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 0.0 < scale < np.inf or np.abs(matrix[3] - _LAST_ROW).max() > 0.0:
        return None
    rotation = rotation_of(matrix[:3, :3] / scale)
    return None if rotation is None else Frame3D(rotation, matrix[:3, 3], scale)


@dataclass(frozen=True, eq=False)
class Fit:
    """A similarity of points to measured ones.

    Attributes:
        frame: The similarity.
        errors: [N, 3] measured minus fitted, in the frame of the measured points.
        kept: [N] bool, which points it was fitted to.
        tilt: Standard error of the turn about the longest extent of the points, radians.
    """

    frame: Frame3D
    errors: NDArray[np.float64]
    kept: NDArray[np.bool_]
    tilt: float


def fit_similarity(points: NDArray[np.float64], measured: NDArray[np.float64]) -> Fit | str:
    """The similarity from points [N, 3] to measured ones [N, 3], or why none can be told.

    Deterministic. From eight points on, those whose residuals are far beyond the others' are left
    out, as long as more than half agree.
    """
    if len(points) < FEWEST:
        return f"there are {len(points)} of them, and {FEWEST} are needed"
    kept = np.ones(len(points), dtype=bool)
    if len(points) >= _FEWEST_TO_REJECT:
        kept = _agreeing(points, measured)
    frame = _frame(points[kept], measured[kept])
    errors = measured - frame.points(points)
    # Three points leave two numbers of nine: seven have gone into the similarity.
    sigma = float(np.sqrt((errors[kept] ** 2).sum() / (3 * int(kept.sum()) - 7)))
    posed = frame.scale * (points[kept] - points[kept].mean(axis=0))
    along, *across = np.linalg.svd(posed, compute_uv=False)
    width = float(np.hypot(*across))
    if not along > 0.0:
        return "they stand all at one place"
    tilt = sigma / width if width > _THINNEST * along else np.inf
    if tilt > _LARGEST_TILT:
        return "they stand in one line, or closer to one than their errors: any turn about it fits"
    return Fit(frame, errors, kept, tilt)


def _agreeing(points: NDArray[np.float64], measured: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] bool, the points that agree with each other."""
    rng = np.random.default_rng(0)
    triples = np.argsort(rng.random((_TRIPLES, len(points))), axis=1)[:, :FEWEST]
    rotations, shifts, scales = _fitted(points[triples], measured[triples])
    some = slice(None, None, -(-len(points) // _MOST_TRIED))
    fitted = scales[:, None, None] * (points[some] @ rotations.transpose(0, 2, 1))
    tried = np.linalg.norm(measured[some] - fitted - shifts[:, None], axis=2)  # [S, n]
    medians = np.median(tried, axis=1)
    best = int(np.argmin(medians))
    frame = Frame3D(rotations[best], shifts[best], float(scales[best]))
    least = _ROUNDING * float(np.abs(measured - measured.mean(axis=0)).max())
    # Worked out again the residuals are rounded in another way: half of them must remain.
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
    """The least-squares similarity of points [N, 3] to measured ones [N, 3]."""
    (rotation,), (shift,), (scale,) = _fitted(points[None], measured[None])
    return Frame3D(rotation, shift, float(scale))


def _fitted(
    points: NDArray[np.float64], measured: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Rotations [S, 3, 3], shifts [S, 3] and scales [S] of S sets of points [S, N, 3]."""
    middle, aim = points.mean(axis=1), measured.mean(axis=1)
    source, target = points - middle[:, None], measured - aim[:, None]
    left, sizes, right = np.linalg.svd(target.transpose(0, 2, 1) @ source)
    # A mirrored solution is turned about its shortest axis.
    signs = np.ones_like(sizes)
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    rotations = (left * signs[:, None]) @ right
    spread = (source**2).sum(axis=(1, 2))
    known = np.where(spread > 0.0, spread, 1.0)
    scales = (sizes * signs).sum(axis=1) / known
    shifts = aim - scales[:, None] * np.einsum("sij,sj->si", rotations, middle)
    return rotations, shifts, scales
