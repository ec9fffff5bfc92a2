"""The backbone slot: the trained representation."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core import defaults
from crossgrad_core.contract.blocks import Block, Parameters
from crossgrad_core.contract.component import Component
from crossgrad_core.contract.gaussians import Gaussians, Response
from crossgrad_core.contract.scene import Camera, Scene
from crossgrad_core.contract.schedule import Phase
from crossgrad_core.errors import UserError


class Backbone(Component):
    """A trained representation: parameters in named blocks, decoded to Gaussians for a camera.

    Attributes:
        default_densifier: Name of the densifier that is used if the user names no densifier. A
            recipe may choose another densifier, for example in short runs of many photos.
        response: Formula of a Gaussian's opacity in a pixel.
        plain: True if the backbone decodes to the same plain Gaussians for every camera, so that a
            standard PLY file contains the complete model.
        sets_dilation: True if the backbone's Gaussians set their own dilation, regardless of the
            rasterizer's dilation.
        passthrough: Field of the Gaussians -> tensor. `decode` returns the tensor unchanged as this
            field, or omits the field, and never reads the tensor. Therefore only the rendered rows
            of the tensor need to be up to date. Subclasses do not inherit this value.
        positions: Name of the tensor [N, 3] of the primitives' positions in the local frame. Before
            the first step and after steps with edits, the primitives are sorted in memory by
            position. The rows of all per-primitive tensors are sorted together, and `prepare` is
            not called. At the end of a run, the rows of floaters may be removed from all these
            tensors. To find floaters, `decode` is called with some of the rows only. If the name is
            empty, only edits move or remove rows.
        axes: Names of two tensors if each primitive is one Gaussian at its position; empty
            otherwise. The first tensor [N, 3] contains logarithms of standard deviations. The
            second tensor [N, 4] contains rotations (quaternions wxyz of any length). Positions may
            then be updated along the axes of the Gaussians, and the standard deviations may be
            bounded. Subclasses do not inherit this value.
    """

    slot: ClassVar[str] = "backbones"
    default_densifier: ClassVar[str] = defaults.DENSIFIER
    response: ClassVar[Response] = "plain"
    plain: ClassVar[bool] = False
    sets_dilation: ClassVar[bool] = False
    passthrough: ClassVar[Mapping[str, str]] = {}
    positions: ClassVar[str] = ""
    axes: ClassVar[tuple[str, str] | tuple[()]] = ()

    @classmethod
    @override
    def __pydantic_init_subclass__(cls, **kwargs: object) -> None:
        # Do not inherit `passthrough`, because the `decode` of a subclass may read a tensor that
        # the parent's `decode` does not read.
        if "passthrough" not in vars(cls):
            cls.passthrough = {}
        # Do not inherit `axes`, because a subclass may store standard deviations and rotations in
        # another form.
        if "axes" not in vars(cls):
            cls.axes = ()

    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """Return the blocks, which are the same at every call."""

    @abstractmethod
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Return initial parameters made from the SfM points, float32 on the CPU."""

    @abstractmethod
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        """Return the Gaussians for a render with `camera`, differentiable in the parameters."""

    def trained_blocks(self) -> tuple[Block, ...]:
        """Return the blocks that get gradients."""
        return tuple(block for block in self.blocks() if not block.frozen)

    @property
    def gaussian_tensors(self) -> tuple[str, str, str] | None:
        """Names of the tensors of positions, scales and rotations, if steps update all their rows.

        None if primitives are not Gaussians with axes, or if the update of some rows may be
        deferred.
        """
        names = self.positions, *self.axes
        late = not set(self.passthrough.values()).isdisjoint(names)
        return names if self.axes and all(names) and not late else None

    @property
    def learns_scales(self) -> bool:
        """True if the primitives are Gaussians with axes whose scales are trained."""
        names = self.gaussian_tensors
        learning = (block for block in self.trained_blocks() if block.lr.initial > 0.0)
        return names is not None and any(names[1] in block.tensors for block in learning)

    def fitted_to(self, scene: Scene) -> tuple["Backbone", tuple[str, ...]]:
        """Return this backbone without options that the scene does not need, and messages.

        Options that the user set are never changed.
        """
        return self, ()

    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Return initial parameters made from existing Gaussians (`--init FILE.ply`), float32, CPU.

        Raises:
            UserError: This backbone cannot start from Gaussians.
        """
        raise UserError(
            "this backbone cannot start from a PLY of Gaussians",
            where="--init",
            found=type(self).__name__,
            todo="use --init points, or a backbone of explicit Gaussians such as "
            f"{defaults.BACKBONE}",
        )

    def prepare(self, parameters: Parameters, scene: Scene, phase: Phase) -> Parameters:
        """Return the parameters with derived tensors updated.

        This method is called before the first step and after every topology edit. A backbone that
        stores derived tensors without gradient (filters, levels) computes them again in this
        method.
        """
        return parameters

    def capped_opacities(self, parameters: Mapping[str, Tensor], cap: float) -> Tensor:
        """Return the tensor `opacities` [N] (logits), limited so that no opacity exceeds `cap`."""
        limit = torch.logit(torch.tensor(cap, dtype=torch.float64)).item()
        return parameters["opacities"].detach().clamp(max=limit)

    def unbaked(self, parameters: Mapping[str, Tensor], phase: Phase) -> Gaussians | None:
        """Return view-independent Gaussians with the backbone's own response, without a graph.

        By default None: the backbone draws with the plain response, or depends on the view.
        """
        return None

    @abstractmethod
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        """Return plain SH Gaussians without a graph, for a standard PLY.

        View-dependent values are evaluated for `cameras` (one or more). Each backbone either
        averages these values or combines them by its own rule.
        """
