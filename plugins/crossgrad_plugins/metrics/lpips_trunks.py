"""The networks whose features LPIPS compares.

Layers that LPIPS does not use are left out. Layers have the numbers of torchvision's `alexnet` and
`vgg16` (`features`), so that torchvision's weight files can be loaded. Sources: Krizhevsky 2014
(arXiv 1404.5997); Simonyan and Zisserman 2015 (1409.1556).
"""

from dataclasses import dataclass
from itertools import groupby
from typing import Final


@dataclass(frozen=True)
class Convolution:
    """A convolution followed by a ReLU.

    Attributes:
        layer: Number of the convolution in torchvision's `features`.
        shape: Shape of its weights: output channels, input channels, height, width.
        stride: Stride, pixels.
        padding: Padding, pixels.
        pools: True if max pooling precedes the convolution.
        compared: True if LPIPS compares the output of the convolution.
    """

    layer: int
    shape: tuple[int, int, int, int]
    stride: int = 1
    padding: int = 1
    pools: bool = False
    compared: bool = True


@dataclass(frozen=True)
class Trunk:
    """A network without its classifier.

    Attributes:
        name: The common name of the network.
        model: The name of the network in torchvision.
        heads: Name of the file with the linear heads.
        published: Name of the weight file with which LPIPS was fitted; the name ends with the first
            digits of the file's SHA-256.
        window: Side length of the max-pooling windows, pixels; their stride is 2.
        smallest: Smallest side length of an image, pixels.
        layers: The convolutions in order.
    """

    name: str
    model: str
    heads: str
    published: str
    window: int
    smallest: int
    layers: tuple[Convolution, ...]

    @property
    def compared(self) -> tuple[Convolution, ...]:
        """The convolutions whose output LPIPS compares, in order."""
        return tuple(layer for layer in self.layers if layer.compared)

    @property
    def digest(self) -> str:
        """The first digits of the published file's SHA-256."""
        return self.published.rpartition("-")[2].partition(".")[0]


def _vgg(stages: tuple[tuple[int, int], ...]) -> tuple[Convolution, ...]:
    """Return the convolutions of VGG; a stage is given as (number of convolutions, channels).

    Max pooling follows each stage, and the last convolution of each stage is compared.
    """
    layers: list[Convolution] = []
    number, channels_in = 0, 3
    widths = [(stage, width) for stage, (count, width) in enumerate(stages) for _ in range(count)]
    for stage, group in groupby(widths, key=lambda pair: pair[0]):
        members = list(group)
        for position, (_, width) in enumerate(members):
            layers.append(
                Convolution(
                    layer=number,
                    shape=(width, channels_in, 3, 3),
                    pools=stage > 0 and position == 0,
                    compared=position == len(members) - 1,
                )
            )
            number, channels_in = number + 2, width
        number += 1  # Max-pooling layers are numbered, too.
    return tuple(layers)


ALEXNET: Final = Trunk(
    name="AlexNet",
    model="alexnet",
    heads="alex.pth",
    published="alexnet-owt-7be5be79.pth",
    window=3,
    smallest=31,
    layers=(
        Convolution(0, (64, 3, 11, 11), stride=4, padding=2),
        Convolution(3, (192, 64, 5, 5), padding=2, pools=True),
        Convolution(6, (384, 192, 3, 3), pools=True),
        Convolution(8, (256, 384, 3, 3)),
        Convolution(10, (256, 256, 3, 3)),
    ),
)

VGG16: Final = Trunk(
    name="VGG-16",
    model="vgg16",
    heads="vgg.pth",
    published="vgg16-397923af.pth",
    window=2,
    smallest=16,
    layers=_vgg(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512))),
)
