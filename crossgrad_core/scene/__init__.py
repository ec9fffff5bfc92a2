"""Scenes: cameras, photos, SfM points, and the similarity back to the input frame."""

from crossgrad_core.contract.scene import Camera, Photo, Scene, View
from crossgrad_core.contract.similarity import Similarity

__all__ = ["Camera", "Photo", "Scene", "Similarity", "View"]
