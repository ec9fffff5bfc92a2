"""Compiled kernels over gradients of all views."""
