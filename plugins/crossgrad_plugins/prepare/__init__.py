"""`crossgrad prepare`: make a scene for `crossgrad run` from a folder of photos."""
