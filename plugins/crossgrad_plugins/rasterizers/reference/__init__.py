"""The readable rasterizer in parts: projection, shape, tiles, compositing, statistics."""
