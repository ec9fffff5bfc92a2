"""Recipes: the decided settings of a run."""
