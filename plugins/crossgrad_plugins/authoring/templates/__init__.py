"""The modules that `crossgrad plugins new` starts from: one for each slot, and one for commands."""
