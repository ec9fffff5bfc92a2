"""The viewer: runs, PLY files and scenes in a browser, drawn by the rasterizer of the run."""
