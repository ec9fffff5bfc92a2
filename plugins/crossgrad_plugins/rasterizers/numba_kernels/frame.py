"""One rendered view as plain arrays: forward pass, backward pass, and their common parts."""

from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import parallel
from crossgrad_plugins.rasterizers.numba_kernels.arrays import (
    CameraArrays,
    DrawOptions,
    Float32,
    Frame,
    GaussianArrays,
    GaussianGradients,
    Int32,
    Int64,
    Projected,
    TileLists,
    in_lines,
)
from crossgrad_plugins.rasterizers.numba_kernels.binning import (
    BUCKET,
    PARTS,
    collect,
    fill_tiles,
    find_tiles,
    start_tiles,
)
from crossgrad_plugins.rasterizers.numba_kernels.ewa import pinhole
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    CHUNK,
    PARTIAL,
    RECORD,
    TILE_HEIGHT,
    TILE_WIDTH,
    vector_constants,
)
from crossgrad_plugins.rasterizers.numba_kernels.longest_axes import add_directions, longest_axes
from crossgrad_plugins.rasterizers.numba_kernels.projection import listed, project
from crossgrad_plugins.rasterizers.numba_kernels.projection_backward import project_backward
from crossgrad_plugins.rasterizers.numba_kernels.reduction import count_pixels
from crossgrad_plugins.rasterizers.numba_kernels.spherical_harmonics import sh_backward, sh_forward
from crossgrad_plugins.rasterizers.numba_kernels.tiles.backward import differentiate
from crossgrad_plugins.rasterizers.numba_kernels.tiles.directions import (
    BINS,
    FIELDS,
    SUMS,
    bin_directions,
)
from crossgrad_plugins.rasterizers.numba_kernels.tiles.forward import composite
from crossgrad_plugins.rasterizers.numba_kernels.tiles.marked import count_marked


def forward(
    gaussians: GaussianArrays, camera: CameraArrays, background: Float32, options: DrawOptions
) -> Frame:
    """Render the Gaussians over a background [3]."""
    projected, boxes, buckets, depths, room = _project(gaussians, camera, options)
    lists = _bin(projected, boxes, buckets, depths, room, boxed=options.response == "analytic")
    shape = (camera.height, camera.width)
    image = np.empty((*shape, 3), np.float32)
    alpha = np.empty(shape, np.float32)
    depth = np.empty(shape, np.float32) if options.depth else None
    counts = np.zeros(lists.slots, np.int32) if options.pixels else None
    masks = np.zeros(lists.entries.shape[0], np.uint64)
    parallel(
        composite,
        lists.starts,
        lists.entries,
        projected.records,
        vector_constants(options.max_alpha),
        np.ascontiguousarray(background, np.float32),
        image,
        alpha,
        depth,
        counts,
        _analytic(options),
        projected.limits,
        masks,
    )
    pixels = None if counts is None else _pixels(projected, lists, counts)
    return Frame(image, alpha, depth, pixels, gaussians, options, projected, lists, masks)


def backward(
    frame: Frame,
    v_image: Float32,
    v_alpha: Float32 | None = None,
    v_depth: Float32 | None = None,
    *,
    absolute: bool = False,
    directions: bool = False,
    harmonics: bool = True,
) -> GaussianGradients:
    """Return the gradients of sum(image * v_image) + sum(alpha * v_alpha) + sum(depth * v_depth).

    Args:
        frame: The frame that `forward` returned; it must contain a depth if `v_depth` is given.
        v_image: [H, W, 3] gradient with respect to the image.
        v_alpha: [H, W] gradient with respect to the accumulated opacity, or None.
        v_depth: [H, W] gradient with respect to the depth, or None.
        absolute: True to compute the absolute gradients with respect to the projected means.
        directions: True to compute the directions of the pixels' gradients.
        harmonics: True to compute the gradients with respect to SH coefficients of higher degrees.
    """
    gaussians, options, projected, lists = (
        frame.gaussians,
        frame.options,
        frame.projected,
        frame.lists,
    )
    partials = in_lines((lists.slots + 1) * PARTIAL)
    partials[-PARTIAL:] = 0.0
    written = np.zeros(lists.slots, np.uint8)
    parallel(
        differentiate,
        lists.starts,
        lists.entries,
        frame.masks,
        projected.records,
        vector_constants(options.max_alpha),
        frame.image,
        frame.alpha,
        frame.depth if v_depth is not None else None,
        np.ascontiguousarray(v_image, np.float32),
        None if v_alpha is None else np.ascontiguousarray(v_alpha, np.float32),
        None if v_depth is None else np.ascontiguousarray(v_depth, np.float32),
        np.empty(0, np.float32) if absolute else None,
        _analytic(options),
        partials,
        written,
    )
    count = gaussians.means.shape[0]
    gradients = GaussianGradients(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        # With spherical harmonics, only the colour gradients of rendered Gaussians are read, so the
        # others need no zeros.
        colors=(np.zeros if gaussians.dc is None else np.empty)((count, 3), np.float32),
        dc=_room(frame, "sh_dc", gaussians.dc),
        rest=_room(frame, "sh_rest", gaussians.rest) if harmonics else None,
        centres=np.empty((count, 2), np.float32),
        absolute=np.empty((count, 2), np.float32) if absolute else None,
        directions=_directions(frame, v_image, v_alpha, v_depth, written) if directions else None,
    )
    parallel(
        project_backward,
        projected.camera,
        _dilation(options),
        options.response == "antialiased",
        _analytic(options),
        v_depth is not None,
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        projected.drawn,
        projected.owners,
        lists.buckets,
        written,
        partials,
        gradients.means,
        gradients.quats,
        gradients.scales,
        gradients.opacities,
        gradients.colors,
        gradients.centres,
        np.empty((0, 2), np.float32) if gradients.absolute is None else gradients.absolute,
    )
    if gradients.dc is not None and gaussians.rest is not None:
        nothing = np.empty((0, *gaussians.rest.shape[1:]), np.float32)
        parallel(
            sh_backward,
            gaussians.degree,
            projected.camera.eye,
            gaussians.means,
            gaussians.rest,
            projected.drawn,
            projected.owners,
            projected.records,
            gradients.colors,
            gradients.dc,
            nothing if gradients.rest is None else gradients.rest,
            gradients.means,
            ("sh_dc" in gaussians.sparse_rows, "sh_rest" in gaussians.sparse_rows, harmonics),
        )
    return gradients


def _room(frame: Frame, field: str, like: Float32 | None) -> Float32 | None:
    """Return an array for a field's gradient: zeros for all Gaussians, or the drawn rows."""
    if like is None:
        return None
    rows = frame.projected.rows
    if rows is not None and field in frame.gaussians.sparse_rows:
        return np.empty((len(rows), *like.shape[1:]), np.float32)
    return np.zeros(like.shape, np.float32)


def _directions(
    frame: Frame,
    v_image: Float32,
    v_alpha: Float32 | None,
    v_depth: Float32 | None,
    written: NDArray[np.uint8],
) -> Float32:
    """Return the directions [N, BINS, FIELDS] of the pixels' gradients, from a separate pass."""
    gaussians, projected, lists = frame.gaussians, frame.projected, frame.lists
    analytic = _analytic(frame.options)
    axes = np.empty(2 * gaussians.means.shape[0], np.float32)
    parallel(
        longest_axes,
        projected.camera,
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        projected.drawn,
        projected.owners,
        axes,
    )
    slot_sums = np.empty(lists.slots * SUMS, np.float32)
    parallel(
        bin_directions,
        lists.starts,
        lists.entries,
        frame.masks,
        projected.records,
        axes,
        vector_constants(frame.options.max_alpha),
        frame.image,
        frame.alpha,
        frame.depth if v_depth is not None else None,
        np.ascontiguousarray(v_image, np.float32),
        None if v_alpha is None else np.ascontiguousarray(v_alpha, np.float32),
        None if v_depth is None else np.ascontiguousarray(v_depth, np.float32),
        analytic,
        slot_sums,
    )
    directions = np.zeros((gaussians.means.shape[0], BINS, FIELDS), np.float32)
    parallel(
        add_directions,
        analytic is not None,
        projected.drawn,
        projected.owners,
        lists.buckets,
        written,
        slot_sums,
        directions,
    )
    return directions


def marked_pixels(
    projected: Projected,
    lists: TileLists,
    masks: NDArray[np.uint64],
    options: DrawOptions,
    marked: NDArray[np.uint8],
) -> Int32:
    """Return for each Gaussian [N] the number of marked pixels in which it was blended.

    Args:
        projected: The field of the view's `Frame`.
        lists: The field of the view's `Frame`.
        masks: The field of the view's `Frame`.
        options: The field of the view's `Frame`.
        marked: [H, W] non-zero for marked pixels.
    """
    counts = np.zeros(lists.slots, np.int32)
    parallel(
        count_marked,
        lists.starts,
        lists.entries,
        masks,
        projected.records,
        vector_constants(options.max_alpha),
        marked,
        _analytic(options),
        counts,
    )
    return _pixels(projected, lists, counts)


def _pixels(projected: Projected, lists: TileLists, counts: Int32) -> Int32:
    """Return [N] the sum of the slots' counts for each Gaussian."""
    pixels = np.zeros_like(projected.radii)
    parallel(count_pixels, projected.drawn, projected.owners, lists.buckets, counts, pixels)
    return pixels


def _analytic(options: DrawOptions) -> Float32 | None:
    """Return an array if the response is analytic, else None.

    Numba compiles separate kernels for the two types. The content of the array is not used. Kernels
    of the analytic response are compiled when they are first used.
    """
    return np.empty(0, np.float32) if options.response == "analytic" else None


def _dilation(options: DrawOptions) -> float:
    return 0.0 if options.response == "analytic" else options.dilation


def _project(
    gaussians: GaussianArrays, camera: CameraArrays, options: DrawOptions
) -> tuple[Projected, Int32, Int32, NDArray[np.float64], Int64]:
    count = gaussians.means.shape[0]
    chunks = (count + CHUNK - 1) // CHUNK
    projected = Projected(
        camera=pinhole(camera.viewmat, camera.intrinsics, camera.width, camera.height),
        radii=np.empty(count, np.int32),
        records=in_lines(count * RECORD),
        owners=np.empty(count, np.int32),
        drawn=np.empty(chunks, np.int64),
        limits=np.empty((count, 2), np.int32) if options.squares else None,
    )
    boxes = np.empty((count, 4), np.int32)
    buckets = np.empty((count, BUCKET), np.int32)
    depths = np.empty(count, np.float64)
    room = np.empty(chunks, np.int64)
    parallel(
        project,
        projected.camera,
        options.near,
        _dilation(options),
        options.response == "antialiased",
        _analytic(options),
        projected.limits,
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.colors,
        projected.radii,
        projected.records,
        depths,
        boxes,
        projected.owners,
        buckets,
        projected.drawn,
        room,
    )
    if gaussians.bring is not None:
        projected = replace(projected, rows=listed(projected.drawn, projected.owners))
        gaussians.bring(projected.rows)
    if gaussians.dc is not None and gaussians.rest is not None:
        parallel(
            sh_forward,
            gaussians.degree,
            projected.camera.eye,
            gaussians.means,
            gaussians.dc,
            gaussians.rest,
            projected.drawn,
            projected.owners,
            projected.records,
            projected.radii,
        )
    return projected, boxes, buckets, depths, room


def _bin(
    projected: Projected,
    boxes: Int32,
    buckets: Int32,
    depths: NDArray[np.float64],
    room: Int64,
    *,
    boxed: bool,
) -> TileLists:
    camera = projected.camera
    columns = (camera.width + TILE_WIDTH - 1) // TILE_WIDTH
    rows = (camera.height + TILE_HEIGHT - 1) // TILE_HEIGHT
    if room.sum() > np.iinfo(np.int32).max:
        raise MemoryError(
            f"the image has {room.sum()} pairs of a Gaussian and a tile, which is too many"
        )
    order, keys, slots = collect(projected.drawn, room, depths, buckets)
    tile_of_slot = np.empty(slots, np.int32)
    counts = np.zeros((PARTS, columns * rows), np.int32)
    parallel(
        find_tiles,
        columns,
        projected.records,
        boxes,
        boxed,
        projected.drawn,
        buckets,
        tile_of_slot,
        counts,
        keys,
        order,
    )
    bands = np.empty(numba.get_num_threads() + 1, np.int64)
    starts = start_tiles(counts, columns, bands)
    entries = np.empty((int(starts[-1]), 2), np.int32)
    parallel(fill_tiles, order, columns, bands, buckets, tile_of_slot, starts, entries)
    return TileLists(starts, entries, buckets, slots)
