"""The rays that a lens model maps to unique pixels, and the image loss by undistortion."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Pinhole

if TYPE_CHECKING:
    import pycolmap

#: Number of directions around the optical axis, and number of steps along each direction: first for
#: a coarse scan, then for a fine scan.
_FIRST, _CLOSER = (72, 128), (180, 360)
#: Largest scanned angle from the optical axis. A pinhole camera cannot show 90 degrees or more.
_WIDEST: Final = np.deg2rad(89.5)
#: The last pixel before the fold is ignored, because undistortion would spread this pixel over many
#: pixels.
_RIM: Final = 1.0
#: Number of cells along each image side for a sum of areas, and number of rows for which a mask is
#: computed at a time.
_CELLS, _ROWS = 64, 256
#: Degree of the polynomial that extrapolates the radius to angles beyond 90 degrees.
_DEGREE: Final = 13


@dataclass(frozen=True, eq=False)
class LensReach:
    """The rays that a lens model maps to unique pixels.

    A lens model folds over at the angle from which the distorted radius no longer grows with the
    undistorted radius. Rays beyond the fold hit pixels that other rays hit as well. Pixels of rays
    beyond the fold therefore show no image content of their own.

    Attributes:
        limits: [A] for each direction, the tangent of the largest angle from the axis before the
            fold. The directions are evenly spread over the circle. The first direction points to
            the right, and the next directions turn downwards.
        folds: True if the fold is inside the photo in any direction.
        wide: True if the photo covers 90 degrees or more from the axis in any direction.
        box: Smallest and largest x, then smallest and largest y, of the rays inside the photo, at
            distance 1.
        seen: Field of view along the longer side of the photo, in degrees.
    """

    limits: NDArray[np.float64]
    folds: bool
    wide: bool
    box: tuple[float, float, float, float]
    seen: float

    @classmethod
    def of(cls, camera: "pycolmap.Camera") -> "LensReach":
        """Compute the rays that a camera maps to unique pixels."""
        first = cls._looked_at(camera, *_FIRST)
        return cls._looked_at(camera, *_CLOSER) if first.folds or first.wide else first

    @classmethod
    def _looked_at(cls, camera: "pycolmap.Camera", directions: int, steps: int) -> "LensReach":
        around = 2.0 * np.pi * np.arange(directions) / directions
        angles = np.linspace(0.0, _WIDEST, steps)
        plane = np.tan(angles)[:, None] * np.stack([np.cos(around), np.sin(around)], 1)[:, None]
        pixels = source_pixels(camera, plane.reshape(-1, 2)).reshape(directions, steps, 2)
        inside = _is_inside(pixels, camera)
        rows = np.arange(directions)
        last = _last_before_fold(pixels / [camera.focal_length_x, camera.focal_length_y])
        ends_inside = inside[rows, last]
        folded = ends_inside & (last < steps - 1)
        rim = pixels[rows, last][:, None]
        near_rim = (np.linalg.norm(pixels - rim, axis=2) < _RIM) | (
            np.arange(steps) > last[:, None]
        )
        kept = np.where(folded, np.maximum(np.argmax(near_rim, axis=1) - 1, 0), last)
        used = inside & (np.arange(steps) <= kept[:, None])
        (left, top), (right, bottom) = (
            plane[used].min(0, initial=0.0),
            plane[used].max(0, initial=0.0),
        )
        return cls(
            limits=np.tan(angles[kept]),
            folds=bool(folded.any()),
            wide=bool((ends_inside & ~folded).any()),
            box=(left, right, top, bottom),
            seen=_seen(camera, pixels, used, np.rad2deg(angles)),
        )

    def beyond(self, plane: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a mask [...] of points [..., 2] at distance 1.

        A point is True if its ray is beyond the fold.
        """
        x, y = plane[..., 0], plane[..., 1]
        around = 2.0 * np.pi * np.arange(len(self.limits)) / len(self.limits)
        limits = np.interp(np.arctan2(y, x), around, self.limits, period=2.0 * np.pi)
        return np.asarray(np.hypot(x, y) > limits)

    def mask(self, frame: Pinhole) -> NDArray[np.bool_]:
        """Return a mask [H, W] of the pixels of a pinhole camera.

        A pixel is True if its ray is before the fold.
        """
        mask = np.empty((frame.height, frame.width), dtype=np.bool_)
        x = np.arange(frame.width) + 0.5
        for start in range(0, frame.height, _ROWS):
            y = np.arange(start, min(start + _ROWS, frame.height)) + 0.5
            mask[start : start + _ROWS] = ~self.beyond(_plane(frame, *np.meshgrid(x, y)))
        return mask


@dataclass(frozen=True)
class LensCost:
    """The image content that is lost by undistortion to a pinhole camera.

    Attributes:
        seen: Field of view along the longer side of the photo, in degrees.
        kept: Part of this field of view that the undistorted photo shows, in degrees.
        lost: Share of the photo's pixels that are missing in the undistorted photo.
        beyond: Share of the undistorted photo's pixels whose rays are beyond the fold.
    """

    seen: float
    kept: float
    lost: float
    beyond: float


def cost_of(camera: "pycolmap.Camera", reach: LensReach, frame: Pinhole) -> LensCost:
    """Return the image content that is lost by undistorting a camera's photos to `frame`."""
    u = np.linspace(0.0, frame.width, _CELLS + 1)
    v = np.linspace(0.0, frame.height, _CELLS + 1)
    plane = _plane(frame, *np.meshgrid(u, v))
    pixels = source_pixels(camera, plane.reshape(-1, 2)).reshape(plane.shape)
    bounds = [camera.width, camera.height]
    within = np.clip(np.nan_to_num(pixels, posinf=0.0, neginf=0.0), 0.0, bounds)
    down, across = within[1:, 1:] - within[:-1, :-1], within[1:, :-1] - within[:-1, 1:]
    areas = 0.5 * np.abs(down[..., 0] * across[..., 1] - down[..., 1] * across[..., 0])
    middles = 0.25 * (plane[1:, 1:] + plane[:-1, :-1] + plane[1:, :-1] + plane[:-1, 1:])
    beyond = reach.beyond(middles)
    corners = np.asarray(np.isfinite(pixels).all(axis=2))
    whole = corners[1:, 1:] & corners[:-1, :-1] & corners[1:, :-1] & corners[:-1, 1:]
    shown = float(areas[whole & ~beyond].sum()) / (camera.width * camera.height)
    x = [-frame.cx / frame.fx, (frame.width - frame.cx) / frame.fx]
    y = [-frame.cy / frame.fy, (frame.height - frame.cy) / frame.fy]
    ends = np.degrees(np.arctan(x if camera.width >= camera.height else y))
    return LensCost(
        seen=reach.seen,
        kept=min(reach.seen, float(ends[1] - ends[0])),
        lost=max(0.0, 1.0 - shown),
        beyond=float(beyond.mean()),
    )


def source_pixels(camera: "pycolmap.Camera", plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project rays through points [N, 2] at distance 1 to pixels [N, 2].

    A ray without a pixel gives NaN.
    """
    rays = np.column_stack([plane, np.ones(len(plane))])
    return np.asarray(camera.img_from_cam(rays), dtype=np.float64).reshape(-1, 2)


def _plane(frame: Pinhole, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points [..., 2] at distance 1 in the pixels of a pinhole camera."""
    return np.stack([(u - frame.cx) / frame.fx, (v - frame.cy) / frame.fy], axis=-1)


def _is_inside(pixels: NDArray[np.float64], camera: "pycolmap.Camera") -> NDArray[np.bool_]:
    """Return a mask [...] of pixels [..., 2].

    A pixel is True if its position is inside the photo; NaN gives False.
    """
    within = (pixels >= 0.0) & (pixels <= [camera.width, camera.height])
    return np.asarray(within.all(axis=-1))


def _last_before_fold(pixels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the last step [A] before the model folds over, for directions `pixels` [A, N, 2].

    Before the fold, the distance from the image centre grows with every step. In addition, the
    determinant of the Jacobian is positive, so that neighbouring directions keep their order.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        radius = np.linalg.norm(pixels - pixels[:, :1], axis=2)
        along = pixels[:, 1:] - pixels[:, :-1]
        around = np.roll(pixels, -1, axis=0)[:, 1:] - pixels[:, 1:]
        turned = along[..., 0] * around[..., 1] - along[..., 1] * around[..., 0]
        grows = (radius[:, 1:] > radius[:, :-1]) & (turned > 0.0)
    return np.asarray(np.where(grows.all(axis=1), grows.shape[1], np.argmin(grows, axis=1)))


def _seen(
    camera: "pycolmap.Camera",
    pixels: NDArray[np.float64],
    used: NDArray[np.bool_],
    degrees: NDArray[np.float64],
) -> float:
    """Return the field of view along the longer side of a photo, in degrees.

    COLMAP's lens models are defined only for angles below 90 degrees from the axis. For larger
    angles, the function extrapolates with a polynomial in the angle. The polynomial fits the
    fisheye models up to rounding.
    """
    axis = 0 if camera.width >= camera.height else 1
    size = (camera.width, camera.height)[axis]
    quarter, steps = len(pixels) // 4, len(degrees)
    ahead, behind = axis * quarter, (axis + 2) * quarter
    ends = [int(used[row].sum()) - 1 for row in (behind, ahead)]
    if max(ends) < steps - 1:
        return float(sum(degrees[max(end, 0)] for end in ends))
    line = [pixels[behind, : ends[0] + 1, axis][::-1], pixels[ahead, 1 : ends[1] + 1, axis]]
    angles = [-degrees[: ends[0] + 1][::-1], degrees[1 : ends[1] + 1]]
    fit = Chebyshev.fit(np.concatenate(angles), np.concatenate(line), _DEGREE)
    farther = np.arange(degrees[-1], 180.0, degrees[1])
    seen = 0.0
    for side, end in zip((-1.0, 1.0), ends, strict=True):
        seen += float(degrees[max(end, 0)])
        if end == steps - 1:
            pixel_positions = fit(side * farther)
            goes_on = (
                (side * np.diff(pixel_positions) > 0.0)
                & (pixel_positions[1:] >= 0.0)
                & (pixel_positions[1:] <= size)
            )
            steps_on = len(goes_on) if goes_on.all() else int(np.argmin(goes_on))
            seen += float(steps_on * degrees[1])
    return seen
