"""Helpers for tests: contract checks for every slot, and tiny scenes."""
