"""Checks before runs are compared: scenes, metrics, machines must agree."""
