"""Evaluation, pictures and files of a trained run."""
