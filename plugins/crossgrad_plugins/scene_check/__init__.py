"""`crossgrad check`: test if points, poses and photos of a scene agree with each other."""
