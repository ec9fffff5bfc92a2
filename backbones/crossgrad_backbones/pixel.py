"""Pixel-GS: the Gaussians of 3DGS with density control that counts pixels (Zhang et al. 2024)."""

from collections.abc import Mapping
from typing import ClassVar

from crossgrad_backbones.vanilla import Vanilla


class PixelGS(Vanilla):
    """The 3DGS representation with the densifier `pixel` by default.

    Source: Pixel-GS, which changes only the densification statistic.
    """

    default_densifier: ClassVar[str] = "pixel"
    passthrough: ClassVar[Mapping[str, str]] = Vanilla.passthrough
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes
