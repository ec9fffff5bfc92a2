"""Built-in rules: actions during training that the training loop itself does not contain."""
