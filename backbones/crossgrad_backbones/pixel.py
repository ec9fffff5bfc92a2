"""Pixel-GS: 3DGS whose density control weights gradients by pixels (Zhang et al. 2024)."""

from collections.abc import Mapping
from typing import ClassVar

from crossgrad_backbones.vanilla import Vanilla


class PixelGS(Vanilla):
    """The 3DGS representation, with `pixel` as the default densifier.

    Source: Pixel-GS, which changes only the statistic for densification.
    """

    default_densifier: ClassVar[str] = "pixel"
    passthrough: ClassVar[Mapping[str, str]] = Vanilla.passthrough
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes
