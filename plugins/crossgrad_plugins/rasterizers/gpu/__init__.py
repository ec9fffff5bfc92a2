"""Code for rasterizers that render on a GPU with another package."""
