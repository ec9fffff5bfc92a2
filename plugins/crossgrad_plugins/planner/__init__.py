"""`crossgrad plan` and `--plan`: what a scene calls for, on evidence that anyone can check."""
