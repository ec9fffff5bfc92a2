"""The files of a COLMAP model: which folder holds them, and their contents."""
