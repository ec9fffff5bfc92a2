"""Gaussians in PLY files."""
