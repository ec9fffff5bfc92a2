"""Which plugins there are, what slots they fill, and how a run calls them."""
