"""The files of a COLMAP model: the search for their folder, and readers of their contents."""
