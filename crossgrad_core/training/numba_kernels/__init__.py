"""Compiled passes over photos."""
