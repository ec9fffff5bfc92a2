"""What rasterizers from other packages that run on a GPU have in common."""
