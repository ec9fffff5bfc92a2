"""A run and its folder: from the configuration to the results."""
