"""Pixel states of the backward passes in segments of eight of a tile, and their step."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    fnma,
    load,
    load_triples,
    splat,
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

#: State of a segment: transmittance (negative once finished), the part S of the loss' linear form
#: still to come (see `backward`), gradient of the three channels.
PASSED, REST, V_RED, V_GREEN, V_BLUE = 0, LANES, 2 * LANES, 3 * LANES, 4 * LANES
STATE = 5 * LANES
#: The gradients of the depths of all segments follow the states of all segments.
DEPTHS = SEGMENTS * STATE


@device
def _start_segment(
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
    """Fills the state of a segment from the pixels from a flat index on."""
    at = segment * STATE
    one = splat(np.float32(1.0))
    r, g, b = load_triples(image, 3 * pixel)
    red, green, blue = load_triples(v_image, 3 * pixel)
    rest = red * r + green * g + blue * b
    if v_alpha is not None:
        rest = rest - load(v_alpha, pixel) * (one - load(alpha, pixel))
    if depth is not None and v_depth is not None:
        v_z = load(v_depth, pixel)
        rest = rest + v_z * load(depth, pixel)
        store(state, DEPTHS + segment * LANES, v_z)
    store(state, at + PASSED, one)
    store(state, at + REST, rest)
    store(state, at + V_RED, red)
    store(state, at + V_GREEN, green)
    store(state, at + V_BLUE, blue)


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
        for segment in range(SEGMENTS):
            store(state, segment * STATE + PASSED, splat(np.float32(-1.0)))
    for y in range(height):
        for column in range(inside // SEGMENT):
            pixel = (top + y) * width + left + column * SEGMENT
            segment = column * TILE_HEIGHT + y
            _start_segment(state, segment, pixel, image, alpha, depth, v_image, v_alpha, v_depth)
        # A segment that the image cuts.
        for x in range(inside - inside % SEGMENT, inside):
            segment = (x // SEGMENT) * TILE_HEIGHT + y
            at = segment * STATE + x % SEGMENT
            i, j = top + y, left + x
            red, green, blue = v_image[i, j, 0], v_image[i, j, 1], v_image[i, j, 2]
            rest = red * image[i, j, 0] + green * image[i, j, 1] + blue * image[i, j, 2]
            if v_alpha is not None:
                rest -= v_alpha[i, j] * (np.float32(1.0) - alpha[i, j])
            if depth is not None and v_depth is not None:
                rest += v_depth[i, j] * depth[i, j]
                state[DEPTHS + segment * LANES + x % SEGMENT] = v_depth[i, j]
            state[at + PASSED] = np.float32(1.0)
            state[at + REST] = rest
            state[at + V_RED] = red
            state[at + V_GREEN] = green
            state[at + V_BLUE] = blue


@device
def odds_of(alpha: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Returns alpha / (1 - alpha)."""
    return alpha / (load(constants, ONE) - alpha)


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
    """Blends a Gaussian into the pixels of a segment.

    Args:
        alpha: The Gaussian's opacity in the pixels, at most the largest; 0 where it is not drawn.
        odds: alpha / (1 - alpha); negative where alpha does not depend on the parameters, since it
            is capped.
        capped: None says that no odds are negative.
        toned: The gradients of the pixels times the colour of the Gaussian.
        state: State of the tile.
        at: Where that of the segment begins.
        constants: From `vector_constants`.

    Returns:
        The weights of the Gaussian in the pixels, and alpha times the loss' gradient by alpha: the
        gradient by the exponent and by the logarithm of the opacity.
    """
    zero = splat(np.float32(0.0))
    before = load(state, at + PASSED)
    weight = alpha * before
    after = before - weight
    blended = after >= load(constants, STOPPED)
    store(state, at + PASSED, where(blended, after, load(constants, FINISHED)))
    weight = where(blended, weight, zero)
    own = weight * toned
    rest = load(state, at + REST) - own
    store(state, at + REST, rest)
    s = fnma(rest, odds, own)
    if capped is not None:
        blended = blended & (odds >= zero)
    return weight, where(blended, s, zero)
