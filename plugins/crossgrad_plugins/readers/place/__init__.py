"""The place of a scene on Earth, and the places where its photos were taken."""
