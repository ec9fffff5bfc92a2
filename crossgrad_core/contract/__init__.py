"""The contract with plugins: data, slots, components, contexts and hooks."""
