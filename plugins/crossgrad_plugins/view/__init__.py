"""The viewer: runs, files of Gaussians and scenes in a browser, drawn by the rasterizer of the run."""
