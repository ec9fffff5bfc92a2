"""The rasterizer slot: Gaussians x Camera -> Render, differentiable."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.gaussians import Gaussians, Render, Response
from crossgrad_core.contract.scene import Camera


class Rasterizer(Component):
    """Draws Gaussians by one common rule set (see docs/rasterizers.md).

    Attributes:
        max_alpha: Cap of a Gaussian's alpha (0.99 as in 3DGS and gsplat 1.6; 0.999 in gsplat 1.5).
        near: Gaussians whose centre is nearer than this camera depth are not drawn, local units.
        dilation: Added to both diagonal entries of the 2-D covariance, px^2.
        provides: Optional outputs it can give: `depth`, `pixels`, `abs_gradient`, `directions`,
            `count`.
        responses: Pixel responses that it draws.
        devices: Torch device types it runs on.
        batched: Whether `render_views` is faster than one view after the other. The views of a
            step are then drawn in one call, with the graphs of all of them alive.
        deterministic: Whether the same input gives the same bits.
        sparse_rows: Whether it heeds `Gaussians.on_demand`. It holds for the very class that says
            so, not for those that inherit from it.
    """

    slot: ClassVar[str] = "rasterizers"
    provides: ClassVar[frozenset[str]] = frozenset()
    responses: ClassVar[frozenset[Response]] = frozenset({"plain"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu"})
    batched: ClassVar[bool] = False
    deterministic: ClassVar[bool] = True
    sparse_rows: ClassVar[bool] = False

    max_alpha: float = Field(0.99, gt=0.0, lt=1.0, description="cap of a Gaussian's alpha")
    near: float = Field(1e-3, gt=0.0, description="near plane, local units")
    dilation: float = Field(0.3, ge=0.0, description="dilation of the 2-D covariance, px^2")

    @classmethod
    @override
    def __pydantic_init_subclass__(cls, **kwargs: object) -> None:
        # A class that inherits it may look at Gaussians before its parent asks for their rows.
        if "sparse_rows" not in vars(cls):
            cls.sparse_rows = False

    @classmethod
    def speed(cls, device: str) -> float:  # noqa: ARG003 - for those that run somewhere
        """How fast it is on a device, for `--rasterizer auto`, which takes the fastest.

        The scale is a rank: 1 the readable reference, 10 compiled kernels on a CPU, 100 on a GPU. 0
        keeps `auto` from taking it: where it does not run, or where it is for those who name it.

        Args:
            device: Torch device type.
        """
        return 0.0

    @classmethod
    def missing(cls, device: str) -> str:  # noqa: ARG003 - for those that need a package
        """Return what it lacks on this machine to run on a device, and how to install it.

        Empty where nothing is missing, or where it does not run on the device at all. `--device
        auto` shows it if a GPU is there and no rasterizer uses it.

        Args:
            device: Torch device type.
        """
        return ""

    def self_test(self, device: str) -> None:
        """Finds out before a run trains whether this machine draws rightly; by default does not.

        Args:
            device: Torch device.

        Raises:
            UserError: It does not.
        """

    @abstractmethod
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        """Draws the Gaussians over `background` [3].

        Image, alpha and (where asked for) depth are differentiable in all tensors of `gaussians`;
        the backward pass fills `Render.screen`. `outputs` names the optional outputs to compute.
        """

    def render_views(
        self,
        views: Sequence[tuple[Gaussians, Camera]],
        backgrounds: Sequence[Tensor],
        outputs: frozenset[str] = frozenset(),
    ) -> list[Render]:
        """Draws several views, each with its own Gaussians and background [3].

        The renders are those of `render`. By default they are drawn one after the other; a
        rasterizer for a GPU may draw them together. One backward pass goes through all of them.
        """
        return [
            self.render(gaussians, camera, background, outputs)
            for (gaussians, camera), background in zip(views, backgrounds, strict=True)
        ]
