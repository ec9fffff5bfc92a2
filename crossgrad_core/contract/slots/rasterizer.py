"""The rasterizer slot: a component renders Gaussians for a camera, differentiably."""

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
    """A renderer of Gaussians that follows the common rules in docs/rasterizers.md.

    Attributes:
        max_alpha: Upper limit of a Gaussian's alpha (0.99 as in 3DGS and gsplat 1.6; 0.999 in
            gsplat 1.5).
        near: Camera depth in local units; Gaussians with a nearer centre are not drawn.
        dilation: Number that is added to both diagonal entries of the 2-D covariance, px^2.
        provides: Optional outputs that the rasterizer can compute: `depth`, `pixels`,
            `abs_gradient`, `directions`, `count`.
        responses: Values of `Gaussians.response` that the rasterizer supports.
        devices: Torch device types that the rasterizer supports.
        batched: True if `render_views` is faster than single renders. The views of a step are then
            rendered in one call, and the autograd graphs of all views are in memory at the same
            time.
        deterministic: True if equal inputs give bitwise equal results.
        sparse_rows: True if the rasterizer supports `Gaussians.on_demand`; subclasses do not
            inherit this value.
    """

    slot: ClassVar[str] = "rasterizers"
    provides: ClassVar[frozenset[str]] = frozenset()
    responses: ClassVar[frozenset[Response]] = frozenset({"plain"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu"})
    batched: ClassVar[bool] = False
    deterministic: ClassVar[bool] = True
    sparse_rows: ClassVar[bool] = False

    max_alpha: float = Field(0.99, gt=0.0, lt=1.0, description="upper limit of a Gaussian's alpha")
    near: float = Field(1e-3, gt=0.0, description="near plane, local units")
    dilation: float = Field(0.3, ge=0.0, description="dilation of the 2-D covariance, px^2")

    @classmethod
    @override
    def __pydantic_init_subclass__(cls, **kwargs: object) -> None:
        # Do not inherit `sparse_rows`, because a subclass may read rows of Gaussians before its
        # parent class requests an update of these rows.
        if "sparse_rows" not in vars(cls):
            cls.sparse_rows = False

    @classmethod
    def speed(cls, device: str) -> float:  # noqa: ARG003 - subclasses use the argument
        """Return a speed rank on a device; `--rasterizer auto` chooses the highest rank.

        The ranks are 1 for the readable reference, 10 for compiled kernels on a CPU, 100 on a GPU.
        Rank 0 means that `auto` never chooses the rasterizer. Then the rasterizer does not support
        the device, or the user must choose it by name.

        Args:
            device: Torch device type.
        """
        return 0.0

    @classmethod
    def missing(cls, device: str) -> str:  # noqa: ARG003 - subclasses use the argument
        """Return the missing requirements for a device on this machine, and how to install them.

        The text is empty if nothing is missing, or if the rasterizer does not support the device.
        `--device auto` shows this text if the machine has a GPU that no rasterizer uses.

        Args:
            device: Torch device type.
        """
        return ""

    def self_test(self, device: str) -> None:
        """Check before training that this machine renders correctly; by default nothing is checked.

        Args:
            device: Torch device.

        Raises:
            UserError: The machine renders incorrectly.
        """

    @abstractmethod
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        """Render the Gaussians over `background` [3].

        Image, alpha and (if requested) depth are differentiable in all tensors of `gaussians`;
        the backward pass fills `Render.screen`. `outputs` names the optional outputs to compute.
        """

    def render_views(
        self,
        views: Sequence[tuple[Gaussians, Camera]],
        backgrounds: Sequence[Tensor],
        outputs: frozenset[str] = frozenset(),
    ) -> list[Render]:
        """Render several views, each with its own Gaussians and background [3].

        The results equal the results of `render`. By default the views are rendered one after
        another. A rasterizer for a GPU may render all views in one call. One backward call then
        serves all views.
        """
        return [
            self.render(gaussians, camera, background, outputs)
            for (gaussians, camera), background in zip(views, backgrounds, strict=True)
        ]
