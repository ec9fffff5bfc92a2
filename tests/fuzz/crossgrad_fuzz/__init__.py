"""Fuzzing of the parsers: mutated files must give a valid value or one clear error, quickly."""
