"""`crossgrad prepare`: from a folder of photos to a scene that `crossgrad run` reads."""
