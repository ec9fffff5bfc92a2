"""What the commands do: run, resume, evaluate, render, export."""
