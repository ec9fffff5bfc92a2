"""Gradient operators that ship with crossgrad."""
