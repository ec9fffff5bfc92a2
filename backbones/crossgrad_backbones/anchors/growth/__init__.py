"""Growth and pruning of anchors (Scaffold-GS)."""
