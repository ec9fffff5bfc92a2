"""The backbone slot: the trained representation."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from torch import Tensor

from crossgrad_core.blocks import Block, Parameters
from crossgrad_core.component import Component
from crossgrad_core.errors import UserError
from crossgrad_core.gaussians import Gaussians
from crossgrad_core.scene.types import Camera, Scene
from crossgrad_core.schedule import Phase


class Backbone(Component):
    """A trained representation: parameters in named blocks, decoded to Gaussians for a camera.

    Attributes:
        default_densifier: Name of the densifier that is used unless the user names another.
    """

    slot: ClassVar[str] = "backbones"
    default_densifier: ClassVar[str] = "adc"

    @abstractmethod
    def blocks(self) -> tuple[Block, ...]:
        """The blocks; fixed for the life of the component."""

    @abstractmethod
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Initial parameters from the SfM points, float32 on the CPU."""

    @abstractmethod
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        """The Gaussians that `camera` sees, differentiable in the parameters."""

    def fitted_to(self, scene: Scene) -> tuple["Backbone", tuple[str, ...]]:
        """This backbone with options that the scene does not need left out, and what was left out.

        Options that the user set are never changed.
        """
        return self, ()

    def adopt(self, gaussians: Gaussians) -> Parameters:
        """Initial parameters from existing Gaussians (`--init FILE.ply`), float32 on the CPU.

        Raises:
            UserError: This backbone cannot start from Gaussians.
        """
        raise UserError(
            "this backbone cannot start from a PLY of Gaussians",
            where="--init",
            found=type(self).__name__,
            todo="use --init points, or a backbone of explicit Gaussians such as vanilla",
        )

    def prepare(self, parameters: Parameters, scene: Scene, phase: Phase) -> Parameters:
        """Called before the first step and after every topology edit; returns the parameters.

        A backbone that keeps derived tensors without gradient (filters, levels) renews them here.
        """
        return parameters

    @abstractmethod
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, camera: Camera | None = None
    ) -> Gaussians:
        """Plain SH Gaussians for a standard PLY; view-dependent ones are baked for `camera`."""
