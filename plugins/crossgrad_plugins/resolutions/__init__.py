"""Built-in resolutions."""
