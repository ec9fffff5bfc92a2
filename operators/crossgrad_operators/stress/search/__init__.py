"""The search for the worst gradients: random families, fast references, local search."""
