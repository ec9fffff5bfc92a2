"""Exposure from SfM tracks: the brightness of photos at the points that they share."""
