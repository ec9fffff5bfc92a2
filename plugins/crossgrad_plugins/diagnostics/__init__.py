"""Statistics of per-view gradients at frozen parameters, from Gramians, and their report."""
