"""What plugins see: data, slots, components, contexts and hooks."""
