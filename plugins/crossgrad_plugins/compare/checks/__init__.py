"""Checks of runs that are compared: scenes, metrics, machines must agree, code should."""
