"""The readable rasterizer, in parts: project, shape, bin into tiles, composite, record."""
