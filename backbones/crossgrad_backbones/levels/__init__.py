"""Levels of detail: how many there are, what stands on each, and when each may be trained."""
