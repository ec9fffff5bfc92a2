"""A rasterizer that calls another rasterizer: a starting point for faster kernels."""

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    Camera,
    Field,
    Gaussians,
    Rasterizer,
    Render,
    Response,
    build_component,
)


class Borrowed(Rasterizer):
    """A rasterizer that renders with another rasterizer."""

    provides: ClassVar[frozenset[str]] = frozenset(
        {"depth", "pixels", "abs_gradient", "directions"}
    )
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased", "analytic"})

    by: str = Field("torch", description="name of the rasterizer that renders the image")

    @override
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        options = self.model_dump(include=set(Rasterizer.model_fields))
        reference = build_component(Rasterizer, self.by, options)
        return reference.render(gaussians, camera, background, outputs)
