"""Photos of a scene: matched by name, checked by their headers, and decoded on demand."""
