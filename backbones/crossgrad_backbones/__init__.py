"""Backbones that ship with crossgrad."""
