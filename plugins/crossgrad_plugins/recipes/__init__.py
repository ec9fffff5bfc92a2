"""Recipes: rules that decide the settings of a run."""
