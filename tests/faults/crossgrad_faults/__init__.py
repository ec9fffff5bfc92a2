"""Faults put into runs of crossgrad, and the laws that hold after them."""
