"""Recipes, which decide settings of a run."""
