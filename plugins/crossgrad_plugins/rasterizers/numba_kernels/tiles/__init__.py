"""Kernels over the pixels of tiles: forward pass, backward pass, and common parts."""
