"""Inputs and outputs of a render as plain arrays."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import WIDE
from crossgrad_core.plugin import Response
from crossgrad_plugins.rasterizers.numba_kernels.ewa import KernelCamera

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]


def in_lines(count: int) -> Float32:
    """Return an array of `count` numbers that is aligned to a cache line of `WIDE` numbers.

    Large arrays of NumPy start 16 bytes after the start of a cache line.
    """
    room = np.empty(count + WIDE, np.float32)
    shift = -(room.ctypes.data // room.itemsize) % WIDE
    return room[shift : shift + count]


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as contiguous float32 arrays.

    The colour is given by `colors`, or by `dc` and `rest`.

    Attributes:
        means: [N, 3] centres, local frame.
        quats: [N, 4] rotations wxyz of any length; a Gaussian with a zero quaternion is not drawn.
        scales: [N, 3] standard deviations along the axes (not their logarithms).
        opacities: [N] opacities in [0, 1].
        colors: [N, 3] RGB colours as rendered.
        dc: [N, 1, 3] SH coefficients of degree 0.
        rest: [N, B - 1, 3] SH coefficients of higher degrees (B - 1 may be 0).
        degree: Active SH degree, 0 to 3.
        sparse_rows: Names of fields with deferred updates. `bring` must update their rows before
            the rows are read, and their gradients contain only these rows.
        bring: Function that performs the deferred updates of the given rows [R] int32.
    """

    means: Float32
    quats: Float32
    scales: Float32
    opacities: Float32
    colors: Float32 | None = None
    dc: Float32 | None = None
    rest: Float32 | None = None
    degree: int = 0
    sparse_rows: frozenset[str] = frozenset()
    bring: Callable[[Int32], None] | None = None


@dataclass(frozen=True)
class CameraArrays:
    """A pinhole camera.

    Attributes:
        viewmat: [4, 4] matrix from world to camera.
        intrinsics: [3, 3] matrix K in pixels; pixel centres are at + 0.5.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
    """

    viewmat: NDArray[np.floating]
    intrinsics: NDArray[np.floating]
    width: int
    height: int


@dataclass(frozen=True)
class DrawOptions:
    """The parameters of the rendering rules, and the optional outputs to compute.

    Attributes:
        max_alpha: Maximum alpha of a Gaussian in a pixel, below 1.
        near: Gaussians are drawn only if the depth of their centre is larger than this.
        dilation: Variance that is added to both diagonal entries of the 2-D covariance, px^2.
        response: How alpha depends on the position of the pixel. `antialiased` lowers opacities to
            compensate for the area that the dilation adds (Mip-Splatting's 2-D filter). `analytic`
            has no dilation.
        squares: True if a Gaussian touches only the tiles of the published 3-sigma square.
        depth: True to compute the accumulated depth.
        pixels: True to count the pixels in which each Gaussian is blended.
    """

    max_alpha: float = 0.99
    near: float = 1e-3
    dilation: float = 0.3
    response: Response = "plain"
    squares: bool = False
    depth: bool = False
    pixels: bool = False


@dataclass(frozen=True)
class Projected:
    """The drawn Gaussians as records in the layout of `layout`.

    Each chunk of Gaussians has an equal number of places for records, and its records use the first
    of these places.

    Attributes:
        camera: The camera of the view.
        radii: [N] int32 radius of each Gaussian, pixels; 0 if it touches no pixel.
        records: [N * RECORD] float32 records.
        owners: [N] int32 index of the Gaussian of each record.
        drawn: [chunks] int64 number of records of each chunk.
        limits: [N, 2] int32 first and last column of 16 pixels that each record may touch; None for
            no limits.
        rows: [R] int32 sorted indices of the Gaussians that have a record; None if not needed.
    """

    camera: KernelCamera
    radii: Int32
    records: Float32
    owners: Int32
    drawn: Int64
    limits: Int32 | None = None
    rows: Int32 | None = None


@dataclass(frozen=True)
class TileLists:
    """For each tile, the records that reach the tile, from front to back.

    Attributes:
        starts: [T + 1] int64 index of the first entry of each tile.
        entries: [E, 2] int32 record and slot of each entry; a slot is the memory for a record in a
            tile.
        buckets: [N, BUCKET] int32 range of the slots of each record.
        slots: Total number of slots.
    """

    starts: Int64
    entries: Int32
    buckets: Int32
    slots: int


@dataclass(frozen=True)
class Frame:
    """A rendered view, and the data for its backward pass.

    Attributes:
        image: [H, W, 3] rendered image over the background, not clamped.
        alpha: [H, W] accumulated opacity.
        depth: [H, W] sum of blending weight times depth; None unless requested.
        pixels: [N] int32 number of pixels in which each Gaussian was blended; None unless
            requested.
        gaussians: The rendered Gaussians.
        options: The options of the render.
        projected: Records of the drawn Gaussians.
        lists: The records of each tile.
        masks: [E] uint64 the 4 x 4 pixel patches in which each entry was blended, one bit per
            patch.
    """

    image: Float32
    alpha: Float32
    depth: Float32 | None
    pixels: Int32 | None
    gaussians: GaussianArrays
    options: DrawOptions
    projected: Projected
    lists: TileLists
    masks: NDArray[np.uint64]


@dataclass(frozen=True)
class GaussianGradients:
    """Gradients of N Gaussians, and gradients for screen statistics, float32.

    Attributes:
        means: [N, 3] gradients with respect to the centres.
        quats: [N, 4] gradients with respect to the quaternions.
        scales: [N, 3] gradients with respect to the scales.
        opacities: [N] gradients with respect to the opacities.
        colors: [N, 3] gradients with respect to the rendered RGB (after SH colours are clamped).
        dc: [N, 1, 3] gradients, or [R, 1, 3] for only the drawn rows; None without SH.
        rest: [N, B - 1, 3] gradients, or [R, B - 1, 3] for only the drawn rows; None without SH or
            if not requested.
        centres: [N, 2] gradients with respect to the projected means, per pixel.
        absolute: [N, 2] sums over pixels of the absolute gradients with respect to the projected
            means; None unless requested.
        directions: [N, 6, 5] the field `directions` of `crossgrad_core.contract.gaussians.Screen`;
            None unless requested.
    """

    means: Float32
    quats: Float32
    scales: Float32
    opacities: Float32
    colors: Float32
    dc: Float32 | None
    rest: Float32 | None
    centres: Float32
    absolute: Float32 | None
    directions: Float32 | None
