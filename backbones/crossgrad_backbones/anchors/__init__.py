"""Anchors with neural Gaussians: the common parts of the Scaffold-GS backbones."""
