"""The position of a scene on Earth, and the GPS positions of its photos."""
