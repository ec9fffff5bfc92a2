"""Compiled loops over the pixels of photos."""
