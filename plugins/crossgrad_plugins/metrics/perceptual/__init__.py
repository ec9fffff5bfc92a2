"""LPIPS: the networks, their weights and the distance."""
