"""`crossgrad check`: points, poses and photos of a scene, held against each other."""
