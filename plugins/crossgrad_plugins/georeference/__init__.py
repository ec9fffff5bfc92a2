"""Where on Earth a scene is, and its Gaussians in coordinates of maps."""
