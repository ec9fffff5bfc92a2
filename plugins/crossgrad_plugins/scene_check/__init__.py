"""`crossgrad check`: whether points, poses and photos of a scene agree with each other."""
