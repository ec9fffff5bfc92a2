"""Built-in rasterizers."""
