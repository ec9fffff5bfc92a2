"""How sure a difference between arms is: estimates, intervals, verdicts; NumPy and SciPy only."""
