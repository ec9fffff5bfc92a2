"""Tile-based CPU kernels of the `numba` rasterizer: plain arrays in, plain arrays out."""
