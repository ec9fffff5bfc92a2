"""`crossgrad compare`: comparison of runs over seeds, scenes, regimes and budgets."""
