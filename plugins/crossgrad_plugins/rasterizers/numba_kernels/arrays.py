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
    """Return an array of `count` numbers that starts at a cache line of `WIDE` numbers.

    NumPy's own large arrays start 16 bytes after the start of a cache line.
    """
    room = np.empty(count + WIDE, np.float32)
    shift = -(room.ctypes.data // room.itemsize) % WIDE
    return room[shift : shift + count]


@dataclass(frozen=True)
class GaussianArrays:
    """N Gaussians as contiguous float32 arrays; colour is `colors`, or `dc` and `rest`.

    Attributes:
        means: [N, 3].
        quats: [N, 4] wxyz, any norm; a zero quaternion is not drawn.
        scales: [N, 3] linear.
        opacities: [N].
        colors: [N, 3] RGB as rendered.
        dc: [N, 1, 3] harmonics of degree 0.
        rest: [N, B - 1, 3] harmonics of higher degrees (B - 1 may be 0).
        degree: Active degree, 0 to 3.
        sparse_rows: Fields whose rows `bring` must update before they are read, and whose gradients
            contain only these rows.
        bring: Function that updates the given rows [R] int32.
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
        viewmat: [4, 4] world to camera.
        intrinsics: [3, 3] K in pixels, pixel centres at + 0.5.
        width: Pixels.
        height: Pixels.
    """

    viewmat: NDArray[np.floating]
    intrinsics: NDArray[np.floating]
    width: int
    height: int


@dataclass(frozen=True)
class DrawOptions:
    """The adjustable numbers of the rule set, and the optional outputs to compute.

    Attributes:
        max_alpha: Cap of a Gaussian's alpha, below 1.
        near: Gaussians are drawn if the depth of their centre is larger.
        dilation: Number that is added to both diagonal entries of the 2-D covariance, px^2.
        response: The response of a Gaussian in a pixel. `antialiased` lowers opacities to
            compensate the area that the dilation adds (Mip-Splatting's 2-D filter); `analytic` has
            no dilation.
        squares: True if a Gaussian touches only the tiles of the published 3-sigma square.
        depth: True to composite the depth.
        pixels: True to count the pixels of each Gaussian.
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
    """The drawn Gaussians as records.

    The records of a chunk of Gaussians begin at the start of the chunk.

    Attributes:
        camera: The view.
        radii: [N] int32, pixels; 0 if no pixel is touched.
        records: [N * RECORD] float32.
        owners: [N] int32, the Gaussian of each record.
        drawn: [chunks] int64, records per chunk.
        limits: [N, 2] int32, columns of 16 pixels that each record may touch; None means no limits.
        rows: [R] int32, the Gaussians that have a record, sorted; None if they are not needed.
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
    """The records that reach each tile, front to back.

    Attributes:
        starts: [T + 1] int64, first entry of each tile.
        entries: [E, 2] int32, records and slots.
        buckets: [N, BUCKET] int32, the slots of each record.
        slots: Number of slots.
    """

    starts: Int64
    entries: Int32
    buckets: Int32
    slots: int


@dataclass(frozen=True)
class Frame:
    """A rendered view and the data for its backward pass.

    Attributes:
        image: [H, W, 3] over the background, not clamped.
        alpha: [H, W].
        depth: [H, W] sum of weight times depth, None unless requested.
        pixels: [N] int32, number of pixels in which each Gaussian was blended, None unless
            requested.
        gaussians: The input Gaussians.
        options: The input options.
        projected: Drawn Gaussians.
        lists: Tile lists.
        masks: [E] uint64, the patches into which each entry was blended.
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
    """Gradients of N Gaussians and their screen statistics, float32.

    Attributes:
        means: [N, 3].
        quats: [N, 4].
        scales: [N, 3].
        opacities: [N].
        colors: [N, 3] with respect to the rendered RGB (after the harmonics are clamped).
        dc: [N, 1, 3], or [R, 1, 3] for the drawn rows; None without harmonics.
        rest: [N, B - 1, 3], or [R, B - 1, 3] for the drawn rows; None without harmonics or if not
            requested.
        centres: [N, 2] with respect to the projected mean, per pixel.
        absolute: [N, 2] with respect to the projected mean, summed as absolute values over pixels;
            None unless requested.
        directions: [N, 6, 5] of `crossgrad_core.contract.gaussians.Screen`; None unless requested.
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
