"""Georeferencing of scenes, and conversion of Gaussians to map coordinates."""
