"""Core of crossgrad: the training loop, the plugin contract, the data types and the command line."""

__version__ = "0.1.0"
