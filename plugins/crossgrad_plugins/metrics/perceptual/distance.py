"""The distance of two images by the features of a network."""

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional

from crossgrad_plugins.metrics.perceptual.trunks import Trunk
from crossgrad_plugins.metrics.perceptual.weights import Weights

#: Mean and standard deviation of ImageNet's colours for images in [-1, 1], as LPIPS has them.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
#: Keeps the length of a vector of features away from 0.
_LEAST = 1e-8


def distance(net: Trunk, weights: Weights, first: Tensor, second: Tensor) -> float:
    """LPIPS of two images [H, W, 3]; those in [-1, 1] are scaled as the method wants it.

    Source: Zhang et al. 2018, The Unreasonable Effectiveness of Deep Features as a Perceptual
    Metric, version 0.1: features of unit length, squared differences, weighted by channel, mean
    over the pixels, sum over the layers.
    """
    with torch.no_grad():
        pairs = zip(_features(net, weights, first), _features(net, weights, second), strict=True)
        total = 0.0
        for (one, other), head in zip(pairs, weights.heads, strict=True):
            difference = (_unit(one) - _unit(other)).square()
            total += float(functional.conv2d(difference, head).mean())
        return total


def _features(net: Trunk, weights: Weights, image: Tensor) -> Iterator[Tensor]:
    """[1, C, h, w] what each compared convolution gives, after its ReLU."""
    shift, scale = image.new_tensor(_SHIFT), image.new_tensor(_SCALE)
    x = ((image - shift) / scale).permute(2, 0, 1)[None]
    for layer, (weight, bias) in zip(net.layers, weights.trunk, strict=True):
        if layer.pools:
            x = functional.max_pool2d(x, net.window, 2)
        x = functional.relu(functional.conv2d(x, weight, bias, layer.stride, layer.padding))
        if layer.compared:
            yield x


def _unit(features: Tensor) -> Tensor:
    """The features of each pixel at length 1."""
    return features / (_LEAST + features.square().sum(dim=1, keepdim=True)).sqrt()
