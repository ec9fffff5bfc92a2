"""Built-in exposures."""
