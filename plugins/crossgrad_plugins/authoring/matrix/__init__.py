"""Train a package's components with all other components: a command and a pytest plugin."""
