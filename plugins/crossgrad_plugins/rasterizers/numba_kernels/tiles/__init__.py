"""Kernels over the pixels of tiles: forward, backward, and what both count."""
