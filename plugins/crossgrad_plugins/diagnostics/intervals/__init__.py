"""Intervals of the variance components."""
