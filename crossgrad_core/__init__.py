"""Core of crossgrad: training loop, plugin contract, data types and command line."""

__version__ = "0.1.0"
