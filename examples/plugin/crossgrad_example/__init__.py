"""One plugin for every slot of crossgrad, and one command."""
