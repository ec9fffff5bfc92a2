"""A package's components trained with all others, as a command and as a plugin of pytest."""
