"""Kernels of the fused loss."""
