"""Compiled kernels of the anchors."""
