"""Scenes: cameras, photos, SfM points, and the similarity transform to the input frame."""

from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import Camera, Photo, Scene, View

__all__ = ["Camera", "Photo", "Scene", "Similarity", "View"]
