"""Pixel states of the backward passes in the pairs of segments of a tile, and their step."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    WIDE,
    Lanes,
    fnma,
    interleaved,
    load,
    load_triples,
    load_wide,
    splat,
    splat_wide,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.constants import FINISHED, ONE, STOPPED
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    SEGMENT,
    SEGMENTS,
    TILE_HEIGHT,
    TILE_WIDTH,
)
from crossgrad_plugins.rasterizers.numba_kernels.segments import lane_of

#: State of a pair of segments, WIDE numbers each: transmittance (negative once finished), the part
#: S of the loss' linear form still to come (see `backward`), gradient of the three channels.
PASSED, REST, V_RED, V_GREEN, V_BLUE = 0, WIDE, 2 * WIDE, 3 * WIDE, 4 * WIDE
STATE = 5 * WIDE
#: The gradients of the depths of all pairs follow the states of all pairs.
DEPTHS = SEGMENTS // 2 * STATE

#: Eight pixels: S, gradient of the three channels, gradient of the depth.
_Eight = tuple[Lanes, Lanes, Lanes, Lanes, Lanes]


@device
def _eight(
    pixel: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> _Eight:
    """Returns what the state of eight pixels begins with, from a flat index on."""
    r, g, b = load_triples(image, 3 * pixel)
    red, green, blue = load_triples(v_image, 3 * pixel)
    rest = red * r + green * g + blue * b
    if v_alpha is not None:
        rest = rest - load(v_alpha, pixel) * (splat(np.float32(1.0)) - load(alpha, pixel))
    v_z = splat(np.float32(0.0))
    if depth is not None and v_depth is not None:
        v_z = load(v_depth, pixel)
        rest = rest + v_z * load(depth, pixel)
    return rest, red, green, blue, v_z


@device
def _start_pair(
    state: NDArray[np.float32],
    segment: int,
    pixel: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> None:
    """Fills the state of a pair; its upper segment are the pixels from a flat index on."""
    at = (segment >> 1) * STATE
    below = pixel + image.shape[1]
    upper = _eight(pixel, image, alpha, depth, v_image, v_alpha, v_depth)
    lower = _eight(below, image, alpha, depth, v_image, v_alpha, v_depth)
    store(state, at + PASSED, splat_wide(np.float32(1.0)))
    store(state, at + REST, interleaved(upper[0], lower[0]))
    store(state, at + V_RED, interleaved(upper[1], lower[1]))
    store(state, at + V_GREEN, interleaved(upper[2], lower[2]))
    store(state, at + V_BLUE, interleaved(upper[3], lower[3]))
    if v_depth is not None:
        store(state, DEPTHS + (segment >> 1) * WIDE, interleaved(upper[4], lower[4]))


@device
def _start_pixel(
    state: NDArray[np.float32],
    segment: int,
    x: int,
    i: int,
    j: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> None:
    """Fills the state of pixel x of a segment, which is (i, j) of the image."""
    lane = lane_of(segment, x)
    at = (segment >> 1) * STATE + lane
    red, green, blue = v_image[i, j, 0], v_image[i, j, 1], v_image[i, j, 2]
    rest = red * image[i, j, 0] + green * image[i, j, 1] + blue * image[i, j, 2]
    if v_alpha is not None:
        rest -= v_alpha[i, j] * (np.float32(1.0) - alpha[i, j])
    if depth is not None and v_depth is not None:
        rest += v_depth[i, j] * depth[i, j]
        state[DEPTHS + (segment >> 1) * WIDE + lane] = v_depth[i, j]
    state[at + PASSED] = np.float32(1.0)
    state[at + REST] = rest
    state[at + V_RED] = red
    state[at + V_GREEN] = green
    state[at + V_BLUE] = blue


@device
def start_tile(
    state: NDArray[np.float32],
    top: int,
    left: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> None:
    """Fills the state of a tile."""
    width = image.shape[1]
    height, inside = min(TILE_HEIGHT, image.shape[0] - top), min(TILE_WIDTH, width - left)
    if height < TILE_HEIGHT or inside < TILE_WIDTH:
        state[:] = np.float32(0.0)
        for segment in range(0, SEGMENTS, 2):
            store(state, (segment >> 1) * STATE + PASSED, splat_wide(np.float32(-1.0)))
    for y in range(0, height, 2):
        # Whole pairs; then the pixels of those that the image cuts.
        whole = inside // SEGMENT if y + 1 < height else 0
        for column in range(whole):
            pixel = (top + y) * width + left + column * SEGMENT
            segment = column * TILE_HEIGHT + y
            _start_pair(state, segment, pixel, image, alpha, depth, v_image, v_alpha, v_depth)
        for i in range(y, min(y + 2, height)):
            for x in range(whole * SEGMENT, inside):
                _start_pixel(
                    state, (x // SEGMENT) * TILE_HEIGHT + i, x % SEGMENT, top + i, left + x,
                    image, alpha, depth, v_image, v_alpha, v_depth,
                )  # fmt: skip


@device
def odds_of(alpha: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Returns alpha / (1 - alpha)."""
    return alpha / (load_wide(constants, ONE) - alpha)


@device
def blend(
    alpha: Lanes,
    odds: Lanes,
    capped: NDArray[np.float32] | None,
    toned: Lanes,
    state: NDArray[np.float32],
    at: int,
    constants: NDArray[np.float32],
) -> tuple[Lanes, Lanes]:
    """Blends a Gaussian into the pixels of a pair of segments.

    Args:
        alpha: The Gaussian's opacity in the pixels, at most the largest; 0 where it is not drawn.
        odds: alpha / (1 - alpha); negative where alpha does not depend on the parameters, since it
            is capped.
        capped: None says that no odds are negative.
        toned: The gradients of the pixels times the colour of the Gaussian.
        state: State of the tile.
        at: Where that of the pair begins.
        constants: From `vector_constants`.

    Returns:
        The weights of the Gaussian in the pixels, and alpha times the loss' gradient by alpha: the
        gradient by the exponent and by the logarithm of the opacity.
    """
    zero = splat_wide(np.float32(0.0))
    before = load_wide(state, at + PASSED)
    weight = alpha * before
    after = before - weight
    blended = after >= load_wide(constants, STOPPED)
    store(state, at + PASSED, where(blended, after, load_wide(constants, FINISHED)))
    weight = where(blended, weight, zero)
    own = weight * toned
    rest = load_wide(state, at + REST) - own
    store(state, at + REST, rest)
    s = fnma(rest, odds, own)
    if capped is not None:
        blended = blended & (odds >= zero)
    return weight, where(blended, s, zero)
