"""Small exact solvers, batched over Gramians, in float64."""
