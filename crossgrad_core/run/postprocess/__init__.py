"""Figures, pictures and files of a run that was trained."""
