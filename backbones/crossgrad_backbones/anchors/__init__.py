"""Anchors that carry neural Gaussians: what the backbones of the Scaffold-GS family share."""
