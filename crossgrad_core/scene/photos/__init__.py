"""Photos of a scene: found by name, checked by their headers, decoded when they are needed."""
