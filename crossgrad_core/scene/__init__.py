"""Scenes: cameras, photos, SfM points, and the similarity back to the input frame."""

from crossgrad_core.scene.types import Camera, Photo, Scene, Similarity, View

__all__ = ["Camera", "Photo", "Scene", "Similarity", "View"]
