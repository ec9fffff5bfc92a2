"""Statistics of per-view gradients at frozen parameters, all from Gramians; and their report."""
