"""How anchors grow and are pruned (Scaffold-GS)."""
