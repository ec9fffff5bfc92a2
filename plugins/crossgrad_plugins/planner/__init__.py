"""`crossgrad plan` and `--plan auto`: what a scene calls for, on evidence that anyone can check."""
