"""An operator, a sampler and a hook wrapper for crossgrad."""
