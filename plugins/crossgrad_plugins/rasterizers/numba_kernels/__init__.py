"""CPU kernels of the `numba` rasterizer, which render tile by tile and use only NumPy arrays."""
