"""The search for the worst gradients: random families, quick references, local search."""
