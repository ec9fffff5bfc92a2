"""Stiff and extreme gradients against exact arithmetic, for every registered operator."""
