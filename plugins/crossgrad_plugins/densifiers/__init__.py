"""Built-in densifiers."""
