"""Compiled kernels of the exposures."""
