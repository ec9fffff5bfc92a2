"""Rendering of held-out views and their metrics."""
