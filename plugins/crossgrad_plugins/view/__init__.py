"""The viewer shows runs, files of Gaussians and scenes in a browser."""
