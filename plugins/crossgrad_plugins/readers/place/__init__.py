"""The place of a scene on Earth, and where its photos were taken."""
