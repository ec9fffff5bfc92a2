"""Compiled kernels of the photometric loss."""
