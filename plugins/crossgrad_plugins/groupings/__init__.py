"""Built-in groupings."""
