"""The things that the viewer shows: the model of a run, the Gaussians of a file, or a scene."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.plugin import (
    Camera,
    Gaussians,
    Model,
    Rasterizer,
    Render,
    Scene,
    Similarity,
    View,
)

#: Draws a camera in the source's local frame, with the optional outputs of the rasterizer.
Draw = Callable[[Camera, frozenset[str]], Render]
#: Quantiles of the coordinates of a file that its local frame is made from, without stray points.
_INNER: Final = (0.05, 0.95)


@dataclass(frozen=True, eq=False)
class Source:
    """One thing that the viewer shows.

    Attributes:
        title: A line about the source for the page.
        similarity: Maps the source's local frame to the coordinates of its files.
        draw: Renders a camera; None for a scene without a model.
        exposed: Applies the exposure of a view; None if no exposure is known.
        views: View name -> view, in the source's local frame.
        version: Number that changes when the model changes.
    """

    title: str
    similarity: Similarity
    draw: Draw | None = None
    exposed: Callable[[View, Tensor], Tensor] | None = None
    views: Mapping[str, View] = field(default_factory=dict)
    version: int = 0

    @classmethod
    def of_model(cls, title: str, model: Model) -> "Source":
        """Return the source of a model as evaluations use it."""

        def draw(camera: Camera, outputs: frozenset[str]) -> Render:
            gaussians = model.backbone.decode(model.parameters, camera, model.phase)
            outputs &= model.rasterizer.provides
            return model.rasterizer.render(gaussians, camera, model.background, outputs)

        views = {view.name: view for view in model.scene.views}
        similarity, version = model.scene.similarity, model.phase.step
        return cls(title, similarity, draw, model.exposed, views, version)

    @classmethod
    def of_gaussians(
        cls, title: str, gaussians: Gaussians, similarity: Similarity, rasterizer: Rasterizer
    ) -> "Source":
        """Return the source of the Gaussians of a file, which are drawn on black."""

        def draw(camera: Camera, outputs: frozenset[str]) -> Render:
            background = torch.zeros(3, device=gaussians.means.device)
            return rasterizer.render(gaussians, camera, background, outputs & rasterizer.provides)

        return cls(title, similarity, draw)

    @classmethod
    def of_scene(cls, title: str, scene: Scene) -> "Source":
        """Return the source of a scene without a model."""
        return cls(title, scene.similarity, views={view.name: view for view in scene.views})


def frame_of(means: NDArray[np.float64]) -> Similarity:
    """Return a frame of about unit size around most points [N, 3] of a file; N may be 0."""
    if not len(means):
        return Similarity(np.zeros(3), 1.0)
    low, high = np.quantile(means, _INNER, axis=0)
    size = float(np.abs(high - low).max())
    return Similarity((low + high) / 2, 2.0 / size if np.isfinite(size) and size > 0 else 1.0)
