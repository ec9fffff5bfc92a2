"""Built-in rules: actions during training that are not part of the basic loop."""
