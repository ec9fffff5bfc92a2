"""A rasterizer."""

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Camera, Gaussians, Rasterizer, Render, Response, build_component

#: Name of the rasterizer that draws meanwhile.
REFERENCE = "torch"


class Template(Rasterizer):
    """Draws as the readable reference does; a place to put faster kernels."""

    provides: ClassVar[frozenset[str]] = frozenset(
        {"depth", "pixels", "abs_gradient", "directions"}
    )
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased", "analytic"})

    @override
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        options = self.model_dump(include=set(Rasterizer.model_fields))
        reference = build_component(Rasterizer, REFERENCE, options)
        return reference.render(gaussians, camera, background, outputs)
