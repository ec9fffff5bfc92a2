"""`crossgrad compare`: runs against each other, over seeds, scenes, regimes and budgets."""
