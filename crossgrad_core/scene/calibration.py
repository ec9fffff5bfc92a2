"""Camera calibrations in COLMAP's models, and undistortion of their photos with pycolmap."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Pinhole
from crossgrad_core.errors import UserError
from crossgrad_core.scene.lens_reach import LensCost, LensReach, cost_of, source_pixels
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

if TYPE_CHECKING:
    import pycolmap

# Camera models that are pinhole cameras if all their distortion parameters are 0. Fisheye models
# are not listed. With zero parameters, fisheye models use an equidistant projection, although
# pycolmap's `is_undistorted` is True.
_PINHOLE_AT_ZERO = frozenset(
    {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_DIVISION", "DIVISION"}
)
_PINHOLE = frozenset({"SIMPLE_PINHOLE", "PINHOLE"})
# Models of panorama photos, which cover all directions.
_ALL_AROUND = frozenset({"EQUIRECTANGULAR"})
# Cameras with values beyond these limits cause overflow in single precision.
_LONGEST_SIDE = 10_000_000  # Number of pixels.
_LARGEST_PARAMETER, _SHORTEST_FOCAL = 1e12, 1e-6
_WHITE = 255
_AGAIN = "correct the camera, or export the model again"


@dataclass(frozen=True)
class Calibration:
    """A camera model of COLMAP together with its parameters.

    Attributes:
        model: COLMAP's name of the model, such as `PINHOLE` or `OPENCV`.
        width: Width of the calibration photos, in pixels.
        height: Height of the calibration photos, in pixels.
        params: Parameters of the model, in COLMAP's order.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def check(self, where: object) -> None:
        """Raise an error if the calibration is not valid.

        Raises:
            UserError: The model is unknown, the number of parameters is wrong, the size is empty, a
                focal length is not positive, or a value is not finite. The message names `where`,
                the source of the calibration.
        """
        if min(self.width, self.height) < 1 or max(self.width, self.height) > _LONGEST_SIDE:
            raise UserError(
                "the image size of a camera is zero or too large",
                where=where,
                expected=f"sides of 1 to {_LONGEST_SIDE:,} pixels",
                found=f"{self.width} x {self.height}",
                todo=_AGAIN,
            )
        try:
            camera = self._camera
            valid = camera.verify_params()
        except (RuntimeError, ValueError, TypeError) as error:
            raise UserError(
                "the camera model is unknown",
                where=where,
                expected="a camera model of COLMAP",
                found=self.model,
                todo="export the model with a camera model of COLMAP, such as PINHOLE or OPENCV",
            ) from error
        if self.model in _ALL_AROUND:
            raise UserError(
                f"camera model {self.model} cannot be converted to a pinhole camera",
                where=where,
                expected="perspective photos",
                found=self.model,
                todo="cut the photos into perspective views first, for example with COLMAP's "
                "panorama tools",
            )
        if not valid:
            raise UserError(
                f"camera model {self.model} has a wrong number of parameters",
                where=where,
                expected=str(camera.params_info),
                found=str(len(self.params)),
                todo=_AGAIN,
            )
        # The comparison is also False for NaN.
        if not all(abs(value) <= _LARGEST_PARAMETER for value in self.params):
            raise UserError(
                "a camera parameter is not a finite number",
                where=where,
                expected=f"numbers from -{_LARGEST_PARAMETER:g} to {_LARGEST_PARAMETER:g}",
                found=f"{self.model} {list(self.params)}",
                todo=_AGAIN,
            )
        focal = [self.params[i] for i in camera.focal_length_idxs()]
        if min(focal, default=1.0) < _SHORTEST_FOCAL:
            raise UserError(
                "the focal length of a camera is not positive",
                where=where,
                expected=f"at least {_SHORTEST_FOCAL:g} pixels",
                found=f"{min(focal):g}",
                todo=_AGAIN,
            )

    @property
    def is_pinhole(self) -> bool:
        """True if photos with this calibration need no undistortion."""
        if self.model in _PINHOLE:
            return True
        extra = [self.params[i] for i in self._camera.extra_params_idxs()]
        return self.model in _PINHOLE_AT_ZERO and not any(extra)

    @property
    def without_distortion(self) -> Pinhole:
        """The pinhole camera with the focal lengths and the principal point of this calibration."""
        return self._read_pinhole(self._camera)

    def resized(self, width: int, height: int) -> "Calibration":
        """Return the calibration for photos that are resampled to `width` x `height`."""
        if (width, height) == (self.width, self.height):
            return self
        if self.is_pinhole:
            pinhole = self.without_distortion.resized(width, height)
            params = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
            return Calibration("PINHOLE", width, height, params)
        camera = self._make_camera()
        camera.rescale(width, height)
        return Calibration(self.model, width, height, tuple(float(p) for p in camera.params))

    @cached_property
    def pinhole(self) -> Pinhole:
        """The pinhole camera after undistortion. Image size and principal point may change.

        Raises:
            UserError: The model cannot be converted to a pinhole camera.
        """
        if self.is_pinhole:
            return self.without_distortion
        whole, (left, top, right, bottom) = self._whole, self._box
        return replace(
            whole,
            width=right - left,
            height=bottom - top,
            cx=whole.cx - left,
            cy=whole.cy - top,
        )

    @cached_property
    def fills_frame(self) -> bool:
        """True if every pixel of the undistorted photo has a source in the distorted photo."""
        if self.is_pinhole:
            return True
        frame = self.pinhole
        u = np.arange(frame.width) + 0.5
        v = np.arange(frame.height) + 0.5
        rows = [np.stack([u, np.full_like(u, y)], 1) for y in (v[0], v[-1])]
        columns = [np.stack([np.full_like(v, x), v], 1) for x in (u[0], u[-1])]
        plane = (np.concatenate(rows + columns) - [frame.cx, frame.cy]) / [frame.fx, frame.fy]
        # Bilinear interpolation needs pixel centres on both sides of a position.
        pixels = source_pixels(self._camera, plane) - 0.5
        inside = (pixels >= 0) & (pixels <= [self.width - 1, self.height - 1])
        return bool(inside.all() and not self._reach.beyond(plane).any())

    @cached_property
    def cost(self) -> LensCost | None:
        """The loss of image content by undistortion; None for a pinhole camera."""
        return None if self.is_pinhole else cost_of(self._camera, self._reach, self.pinhole)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistort a photo to the pixels of `pinhole` by bilinear interpolation.

        Pixels without a source become black.

        Args:
            image: [H, W, 3] or [H, W] photo, in the size of the calibration.
        """
        guard_pycolmap()
        import pycolmap

        bitmap, _ = pycolmap.undistort_image(
            self._options, pycolmap.Bitmap.from_array(image), self._camera
        )
        left, top, right, bottom = self._box
        return np.asarray(bitmap.to_array())[top:bottom, left:right]

    def reached(self) -> NDArray[np.bool_]:
        """Return a mask [H, W] of the pixels of `pinhole`.

        A pixel is True if the photo covers the pixel, and the ray of the pixel is before the fold
        of the lens model.
        """
        white = np.full((self.height, self.width), _WHITE, dtype=np.uint8)
        shown: NDArray[np.bool_] = self.undistort(white) == _WHITE
        return shown & self._reach.mask(self.pinhole) if self._reach.folds else shown

    @cached_property
    def _reach(self) -> LensReach:
        return LensReach.of(self._camera)

    @cached_property
    def _options(self) -> "pycolmap.UndistortCameraOptions":
        """The options of pycolmap's undistortion.

        For a very wide lens, rays below 90 degrees from the axis may all be inside the photo. For
        such a lens, pycolmap shrinks the undistorted photo to the smallest allowed size. The
        options for such a lens therefore require at least the size of the original photo.
        """
        guard_pycolmap()
        import pycolmap

        options = pycolmap.UndistortCameraOptions()
        # The call of `_undistorted` also raises an error for models that cannot be undistorted,
        # before `_reach` is computed.
        smallest = self._undistorted(options).width <= options.min_scale * self.width
        if smallest and (self._reach.folds or self._reach.wide):
            options.min_scale = 1.0
        return options

    @cached_property
    def _whole(self) -> Pinhole:
        """The pinhole camera after undistortion, but before cropping."""
        return self._undistorted(self._options)

    def _undistorted(self, options: "pycolmap.UndistortCameraOptions") -> Pinhole:
        guard_pycolmap()
        import pycolmap

        try:
            camera = pycolmap.undistort_camera(options, self._camera)
        except (RuntimeError, ValueError) as error:
            raise UserError(
                f"photos of camera model {self.model} cannot be undistorted to a pinhole camera",
                found=str(error),
                todo="export perspective photos, for example with COLMAP's image undistorter",
            ) from error
        return self._read_pinhole(camera)

    @cached_property
    def _box(self) -> tuple[int, int, int, int]:
        """Borders of `pinhole` in the pixels of `_whole`: left, top, right, bottom.

        If the lens model folds over inside the photo, all pixels outside the valid region are
        cropped.
        """
        whole = self._whole
        if not self._reach.folds:
            return 0, 0, whole.width, whole.height
        low_x, high_x, low_y, high_y = self._reach.box
        left = int(np.clip(whole.cx + low_x * whole.fx, 0, whole.width - 1))
        top = int(np.clip(whole.cy + low_y * whole.fy, 0, whole.height - 1))
        right = int(np.clip(whole.cx + high_x * whole.fx + 1, left + 1, whole.width))
        bottom = int(np.clip(whole.cy + high_y * whole.fy + 1, top + 1, whole.height))
        return left, top, right, bottom

    @cached_property
    def _camera(self) -> "pycolmap.Camera":
        return self._make_camera()

    def _make_camera(self) -> "pycolmap.Camera":
        guard_pycolmap()
        import pycolmap

        return pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.params)
        )

    @staticmethod
    def _read_pinhole(camera: "pycolmap.Camera") -> Pinhole:
        matrix = camera.calibration_matrix()
        fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Pinhole(camera.width, camera.height, fx, fy, cx, cy)
