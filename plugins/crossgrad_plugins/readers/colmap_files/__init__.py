"""The files of a COLMAP model: the folder with the files, and their contents."""
