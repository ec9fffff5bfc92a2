"""Kernels over the pixels of tiles: forward, backward, and the parts that both passes share."""
