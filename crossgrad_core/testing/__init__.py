"""Helpers for tests: contract checks for every slot, and small scenes."""
