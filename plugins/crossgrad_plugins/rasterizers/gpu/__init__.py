"""Common parts of rasterizers that draw on a GPU with another package."""
