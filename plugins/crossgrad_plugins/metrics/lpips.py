"""LPIPS with AlexNet and with VGG-16."""

from abc import abstractmethod
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

import torch
from pydantic import field_validator
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Compared, Field, Figure, Metric, Selection, hookimpl, masked
from crossgrad_plugins.metrics.lpips_trunks import ALEXNET, VGG16, Trunk

if TYPE_CHECKING:
    from crossgrad_plugins.metrics.lpips_distance import Weights


#: Texts for summary.json about the value range of the network's input.
IN_FULL_RANGE: Final = "images in [-1, 1], as the method means it"
IN_UNIT_RANGE: Final = "images in [0, 1], as 3DGS feeds them"


def figure_of(name: str, label: str, net: Trunk, entry: str, scaling: str) -> Figure:
    """Return the `Figure` of LPIPS before the weights are read; `described` adds their source."""
    return Figure(
        name=name,
        label=label,
        definition=f"LPIPS 0.1 with {net.name}, {scaling}; masked pixels are black in both images",
        undefined=f"LPIPS needs the pretrained {net.name}, which no Python package contains: "
        f"name it with --set metrics.{entry}.trunk=FILE, for example {net.published} "
        "of torchvision",
        falls=True,
    )


class Perceptual(Metric):
    """Learned perceptual similarity (LPIPS 0.1) with weights that the user provides.

    The user must give a trunk file, because no Python package contains a trunk. Without the file,
    the result is null. Files are never downloaded.

    Attributes:
        net: The network whose features are compared.
        entry: The name of the metric, for messages.
    """

    net: ClassVar[Trunk]
    entry: ClassVar[str]

    trunk: Path | None = Field(
        None,
        description="file with the weights of the network as torchvision publishes them (.pth or "
        ".safetensors); null: LPIPS is not computed",
    )
    heads: Path | None = Field(
        None,
        description="file with the linear heads of LPIPS 0.1; by default the heads in an "
        "installed torchmetrics or lpips package",
    )

    @field_validator("trunk", "heads")
    @classmethod
    def _from_anywhere(cls, path: Path | None) -> Path | None:
        """Make a path absolute, so that config.yaml can be used from any folder."""
        return None if path is None else path.expanduser().absolute()

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Read the weights now, so that errors appear before training starts."""
        if self.trunk is not None:
            self._weights(self.trunk)
        elif self.heads is not None:
            setting = f"metrics.{self.entry}"
            return [f"{setting}.heads has no effect without a network: --set {setting}.trunk=FILE"]
        return []

    @override
    def described(self) -> Figure:
        if self.trunk is None:
            return self.figure
        least = f"{self.net.name} needs images whose sides have at least {self.net.smallest} pixels"
        definition = f"{self.figure.definition}; {self._weights(self.trunk).source}"
        return replace(self.figure, definition=definition, undefined=least)

    @override
    def measure(self, compared: Compared) -> float | None:
        mask = compared.mask
        small = min(compared.render.shape[:2]) < self.net.smallest
        if self.trunk is None or small or (mask is not None and not bool(mask.any())):
            return None
        from crossgrad_plugins.metrics.lpips_distance import distance

        render, photo = (
            self.entering(masked(image.to(torch.float32) / 255, mask))
            for image in (compared.render, compared.photo)
        )
        return distance(self.net, self._weights(self.trunk), render, photo)

    @abstractmethod
    def entering(self, image: Tensor) -> Tensor:
        """Return an image [H, W, 3] in [0, 1], scaled to the value range that the network gets."""

    def _weights(self, trunk: Path) -> "Weights":
        return _kept(self.net, trunk, self.heads, f"metrics.{self.entry}")


class LPIPS(Perceptual):
    """Learned perceptual similarity with AlexNet; lower is better.

    Images are scaled to [-1, 1].
    """

    net: ClassVar[Trunk] = ALEXNET
    entry: ClassVar[str] = "lpips"
    figure: ClassVar[Figure] = figure_of("lpips", "LPIPS", ALEXNET, entry, IN_FULL_RANGE)

    @override
    def entering(self, image: Tensor) -> Tensor:
        return 2 * image - 1


class LPIPSOfVGG(Perceptual):
    """Learned perceptual similarity with VGG-16; lower is better.

    Images are scaled to [-1, 1].
    """

    net: ClassVar[Trunk] = VGG16
    entry: ClassVar[str] = "lpips-vgg"
    figure: ClassVar[Figure] = figure_of("lpips_vgg", "LPIPS (VGG)", VGG16, entry, IN_FULL_RANGE)

    @override
    def entering(self, image: Tensor) -> Tensor:
        return 2 * image - 1


class LPIPSOfVGGAs3DGS(Perceptual):
    """Learned perceptual similarity with VGG-16 on images in [0, 1], as in the 3DGS code.

    The network was trained for images in [-1, 1], so images in [0, 1] have too little contrast for
    it. The result can be compared only with LPIPS values in papers that use the 3DGS code.
    """

    net: ClassVar[Trunk] = VGG16
    entry: ClassVar[str] = "lpips-vgg-3dgs"
    figure: ClassVar[Figure] = figure_of(
        "lpips_vgg_3dgs", "LPIPS (VGG, 3DGS)", VGG16, entry, IN_UNIT_RANGE
    )

    @override
    def entering(self, image: Tensor) -> Tensor:
        return image


@lru_cache(maxsize=4)
def _kept(net: Trunk, trunk: Path, heads: Path | None, setting: str) -> "Weights":
    from crossgrad_plugins.metrics.lpips_distance import read_weights

    return read_weights(net, trunk, heads, setting)
