"""The patches of a tile, and the states of their pixels in the backward passes."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    first_half,
    fnma,
    joined,
    last_half,
    load,
    load_triples,
    load_wide,
    picking,
    splat,
    splat_wide,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    COLUMNS,
    FINISHED,
    ONE,
    PATCHES,
    SIDE,
    STOPPED,
    TILE_HEIGHT,
    TILE_WIDTH,
)

_PLACES = [(x, y) for x in range(SIDE) for y in range(SIDE)]
# Arrange four rows of eight pixels, given as two pairs of rows, as the left patch and the right
# patch.
_left_patch, _right_patch = (
    picking([y * LANES + start + x for x, y in _PLACES]) for start in (0, SIDE)
)
# Arrange the left and the right patch as the first two and the last two rows of pixels.
_first_rows, _last_rows = (
    picking([x // SIDE * WIDE + x % SIDE * SIDE + y for y in rows for x in range(LANES)])
    for rows in ((0, 1), (2, 3))
)


@device
def row_of(patch: int) -> int:
    """Return the first pixel row of a patch."""
    return (patch // COLUMNS) * SIDE


@device
def column_of(patch: int) -> int:
    """Return the column of patches in which a patch is."""
    return patch & (COLUMNS - 1)


@device
def place_of(x: int, y: int) -> tuple[int, int]:
    """Return the patch that contains pixel (x, y) of a tile, and the lane of the pixel."""
    return (y // SIDE) * COLUMNS + x // SIDE, (x % SIDE) * SIDE + y % SIDE


@device
def two_patches(a: Lanes, b: Lanes, c: Lanes, d: Lanes) -> tuple[Lanes, Lanes]:
    """Return two adjacent patches from four rows of eight pixels."""
    above, below = joined(a, b), joined(c, d)
    return _left_patch(above, below), _right_patch(above, below)


@device
def four_rows(left: Lanes, right: Lanes) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Return the four rows of eight pixels of two adjacent patches."""
    above, below = _first_rows(left, right), _last_rows(left, right)
    return first_half(above), last_half(above), first_half(below), last_half(below)


#: State of a patch, WIDE numbers each: transmittance (negative after a pixel is finished), the
#: remaining part S of the linearised loss (see `backward`), and the gradients of three channels.
PASSED, REST, V_RED, V_GREEN, V_BLUE = 0, WIDE, 2 * WIDE, 3 * WIDE, 4 * WIDE
STATE = 5 * WIDE
#: The gradients of the depths of all patches follow after the states of all patches.
DEPTHS = PATCHES * STATE
#: Values of eight pixels: S, the gradients of three channels, and the gradient of the depth.
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
    """Return the initial values of eight pixels, from a flat index on."""
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
def _store_two(
    state: NDArray[np.float32], at: int, ahead: int, a: Lanes, b: Lanes, c: Lanes, d: Lanes
) -> None:
    """Write four rows of eight pixels to a patch and to the patch that is `ahead` floats later."""
    left, right = two_patches(a, b, c, d)
    store(state, at, left)
    store(state, at + ahead, right)


@device
def _start_two(
    state: NDArray[np.float32],
    patch: int,
    pixel: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> None:
    """Write the states of a patch and its right neighbour, from a flat pixel index on."""
    at, width = patch * STATE, image.shape[1]
    a = _eight(pixel, image, alpha, depth, v_image, v_alpha, v_depth)
    b = _eight(pixel + width, image, alpha, depth, v_image, v_alpha, v_depth)
    c = _eight(pixel + 2 * width, image, alpha, depth, v_image, v_alpha, v_depth)
    d = _eight(pixel + 3 * width, image, alpha, depth, v_image, v_alpha, v_depth)
    one = splat(np.float32(1.0))
    _store_two(state, at + PASSED, STATE, one, one, one, one)
    _store_two(state, at + REST, STATE, a[0], b[0], c[0], d[0])
    _store_two(state, at + V_RED, STATE, a[1], b[1], c[1], d[1])
    _store_two(state, at + V_GREEN, STATE, a[2], b[2], c[2], d[2])
    _store_two(state, at + V_BLUE, STATE, a[3], b[3], c[3], d[3])
    if v_depth is not None:
        _store_two(state, DEPTHS + patch * WIDE, WIDE, a[4], b[4], c[4], d[4])


@device
def _start_pixel(
    state: NDArray[np.float32],
    patch: int,
    lane: int,
    i: int,
    j: int,
    image: NDArray[np.float32],
    alpha: NDArray[np.float32],
    depth: NDArray[np.float32] | None,
    v_image: NDArray[np.float32],
    v_alpha: NDArray[np.float32] | None,
    v_depth: NDArray[np.float32] | None,
) -> None:
    """Write the state of one lane of a patch, for pixel (i, j) of the image."""
    at = patch * STATE + lane
    red, green, blue = v_image[i, j, 0], v_image[i, j, 1], v_image[i, j, 2]
    rest = red * image[i, j, 0] + green * image[i, j, 1] + blue * image[i, j, 2]
    if v_alpha is not None:
        rest -= v_alpha[i, j] * (np.float32(1.0) - alpha[i, j])
    if depth is not None and v_depth is not None:
        rest += v_depth[i, j] * depth[i, j]
        state[DEPTHS + patch * WIDE + lane] = v_depth[i, j]
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
    """Write the initial state of a tile."""
    width = image.shape[1]
    high, wide = min(TILE_HEIGHT, image.shape[0] - top), min(TILE_WIDTH, width - left)
    if high < TILE_HEIGHT or wide < TILE_WIDTH:
        state[:] = np.float32(0.0)
        for patch in range(PATCHES):
            store(state, patch * STATE + PASSED, splat_wide(np.float32(-1.0)))
    # Process pairs of complete patches first, then the remaining pixels one by one.
    whole_high, whole_wide = high - high % SIDE, wide - wide % LANES
    for y in range(0, whole_high, SIDE):
        for x in range(0, whole_wide, LANES):
            patch, _ = place_of(x, y)
            pixel = (top + y) * width + left + x
            _start_two(state, patch, pixel, image, alpha, depth, v_image, v_alpha, v_depth)
    for y in range(high):
        for x in range(whole_wide if y < whole_high else 0, wide):
            patch, lane = place_of(x, y)
            _start_pixel(
                state, patch, lane, top + y, left + x,
                image, alpha, depth, v_image, v_alpha, v_depth,
            )  # fmt: skip


@device
def odds_of(alpha: Lanes, constants: NDArray[np.float32]) -> Lanes:
    """Return alpha / (1 - alpha)."""
    return alpha / (load_wide(constants, ONE) - alpha)


@device
def blend(
    alpha: Lanes,
    odds: Lanes,
    capped: NDArray[np.float32] | None,
    weighted_color: Lanes,
    state: NDArray[np.float32],
    at: int,
    constants: NDArray[np.float32],
) -> tuple[Lanes, Lanes]:
    """Blend a Gaussian into the pixels of a patch.

    Args:
        alpha: The alpha of the Gaussian in each pixel, at most the cap; 0 if it is not drawn there.
        odds: alpha / (1 - alpha) of each pixel; negative if alpha is capped and therefore has no
            gradient.
        capped: None if no odds are negative.
        weighted_color: The gradients of the pixels, times the colour of the Gaussian.
        state: State of the tile, which is updated.
        at: Index of the first element of the patch's state.
        constants: Constants from `vector_constants`.

    Returns: The blending weight of the Gaussian in each pixel, and alpha times the gradient with
    respect to alpha. The second result equals the gradients with respect to the exponent and to the
    logarithm of the opacity.
    """
    zero = splat_wide(np.float32(0.0))
    before = load_wide(state, at + PASSED)
    weight = alpha * before
    after = before - weight
    blended = after >= load_wide(constants, STOPPED)
    store(state, at + PASSED, where(blended, after, load_wide(constants, FINISHED)))
    weight = where(blended, weight, zero)
    contribution = weight * weighted_color
    rest = load_wide(state, at + REST) - contribution
    store(state, at + REST, rest)
    s = fnma(rest, odds, contribution)
    if capped is not None:
        blended = blended & (odds >= zero)
    return weight, where(blended, s, zero)
