"""Exposure from SfM tracks: the brightness of photos at points that several photos show."""
