"""The files of a COLMAP model: the folder that holds them, and their contents."""
