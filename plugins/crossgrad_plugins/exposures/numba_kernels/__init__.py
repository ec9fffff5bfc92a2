"""Kernels of exposures."""
