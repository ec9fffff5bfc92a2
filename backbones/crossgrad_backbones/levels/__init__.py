"""Levels of detail of octree anchors: the lattices of all levels, and growth and pruning."""
