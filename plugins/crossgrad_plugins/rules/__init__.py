"""Built-in rules: what acts during training and is not part of the basic loop."""
