"""The patches of a tile that a Gaussian reaches, compared with a test of every pixel."""

import numpy as np

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.simd import WIDE, load_wide
from crossgrad_plugins.rasterizers.numba_kernels.tiles.footprint import reached_patches


@kernel
def _reached(first, last):
    return reached_patches(load_wide(first, 0), load_wide(last, 0))


def test_reached_patches_are_exactly_the_patches_with_a_touched_pixel():
    rng = np.random.default_rng(0)
    for _ in range(300):
        first = np.round(rng.normal(30, 30, WIDE)).astype(np.float32)
        last = (first + np.round(rng.normal(6, 12, WIDE))).astype(np.float32)
        wild = rng.random(WIDE) < 0.2
        last[wild] = rng.choice(np.array([np.nan, np.inf, -np.inf, 1e30], np.float32), wild.sum())
        expected = 0
        for row in range(WIDE):
            for x in range(64):
                if first[row] <= x <= last[row]:
                    expected |= 1 << (16 * (row // 4) + x // 4)
        assert _reached(first, last) == expected
