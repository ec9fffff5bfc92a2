"""Training of a package's components with all others, as a command and as a pytest plugin."""
