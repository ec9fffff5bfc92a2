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
        default_densifier: Name of the densifier that is used unless the user names another; in
            short runs of many photos another one stands in for that of the published Gaussians.
        response: How its Gaussians fill a pixel.
        plain: Whether it decodes to the same plain Gaussians for every camera, so that a standard
            PLY loses nothing.
        sets_dilation: Whether its Gaussians' dilation is its own, whatever the rasterizer's is.
        passthrough: Field of the Gaussians -> tensor that `decode` hands over as this field (or not
            at all) and does not read: only the rows that are drawn need to be up to date. It
            holds for the very class that says so, not for those that inherit from it.
        positions: Tensor [N, 3] of the primitives' positions in the local frame, by which they are
            put in order in memory, before the first step and after steps that edit: all rows of all
            per-primitive tensors together, and without a call of `prepare`. At the end of a run
            rows are removed likewise, after `decode` was asked what some of them alone give
            (floaters). Where it is empty, only edits move or remove rows.
        axes: Tensors [N, 3] of the logarithms of standard deviations and [N, 4] of rotations (wxyz,
            of any length) of Gaussians that primitives are, each about its position, which may then
            step along these axes, and whose deviations may be bounded. Empty where primitives are
            none. Of the very class, too.
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
        # A class that inherits it may read in `decode` what its parent only hands over.
        if "passthrough" not in vars(cls):
            cls.passthrough = {}
        # ... and hold its sizes and rotations in another way.
        if "axes" not in vars(cls):
            cls.axes = ()

    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """The blocks; fixed for the life of the component."""

    @abstractmethod
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Initial parameters from the SfM points, float32 on the CPU."""

    @abstractmethod
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        """The Gaussians that `camera` sees, differentiable in the parameters."""

    def trained_blocks(self) -> tuple[Block, ...]:
        """The blocks that get gradients."""
        return tuple(block for block in self.blocks() if not block.frozen)

    @property
    def gaussian_tensors(self) -> tuple[str, str, str] | None:
        """The tensors of positions, scales and rotations of Gaussians that steps update whole.

        None if primitives are no such Gaussians, or if rows may be updated late.
        """
        names = self.positions, *self.axes
        late = not set(self.passthrough.values()).isdisjoint(names)
        return names if self.axes and all(names) and not late else None

    @property
    def learns_scales(self) -> bool:
        """Whether Gaussians with axes learn their scales, so that these can be bounded."""
        names = self.gaussian_tensors
        learning = (block for block in self.trained_blocks() if block.lr.initial > 0.0)
        return names is not None and any(names[1] in block.tensors for block in learning)

    def fitted_to(self, scene: Scene) -> tuple["Backbone", tuple[str, ...]]:
        """This backbone with options that the scene does not need left out, and what was left out.

        Options that the user set are never changed.
        """
        return self, ()

    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Initial parameters from existing Gaussians (`--init FILE.ply`), float32 on the CPU.

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
        """Called before the first step and after every topology edit; returns the parameters.

        A backbone that keeps derived tensors without gradient (filters, levels) renews them here.
        """
        return parameters

    def capped_opacities(self, parameters: Mapping[str, Tensor], cap: float) -> Tensor:
        """The tensor `opacities` [N] (logits) with no Gaussian drawn more opaque than `cap`."""
        limit = torch.logit(torch.tensor(cap, dtype=torch.float64)).item()
        return parameters["opacities"].detach().clamp(max=limit)

    @abstractmethod
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        """Plain SH Gaussians without a graph, for a standard PLY.

        What depends on the view is baked as `cameras` (one or more) see it: on average, or as a
        rule of the backbone's says.
        """
