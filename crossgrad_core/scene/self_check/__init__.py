"""The consistency check of a scene: agreement of its points, poses and photos."""
