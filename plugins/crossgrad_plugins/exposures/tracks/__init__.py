"""Exposure from SfM tracks: how bright photos are where they show the same points."""
