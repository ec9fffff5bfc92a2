"""The render with its colours fitted to the photo: what is left once colour alone is forgiven."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.plugin import Compared

#: What stands in summary.json with every colour-corrected figure.
DEFINITION = (
    "of the render after the affine map of RGB (3 x 4, 8-bit sRGB values) that brings it closest "
    "to the photo of the view by least squares over the pixels that count; "
    "clamped and rounded to 8 bits again"
)

#: Directions of colour in which a render varies less than this, relative to the widest, are fitted
#: as if it did not vary in them: a grey render has two such directions, but for rounding.
_FLAT = 1e-10

Floats = NDArray[np.float64]


def color_corrected(compared: Compared) -> Tensor | None:
    """[H, W, 3] uint8, the render after the affine map that fits it best to its photo.

    The map is fitted where the mask is True and applied everywhere. None where no pixel counts.
    """
    render, photo = (_kept(image, compared.mask) for image in (compared.render, compared.photo))
    if not len(render):
        return None
    matrix, offset = _fit(render, photo)
    pixels = compared.render.numpy().astype(np.float64) @ matrix + offset
    return torch.from_numpy(np.rint(np.clip(pixels, 0.0, 255.0)).astype(np.uint8))


def _kept(image: Tensor, mask: Tensor | None) -> Floats:
    """[N, 3] the pixels that count."""
    kept = image.reshape(-1, 3) if mask is None else image[mask]
    return kept.numpy().astype(np.float64)


def _fit(render: Floats, photo: Floats) -> tuple[Floats, Floats]:
    """Matrix [3, 3] and offset [3]: `render @ matrix + offset` is closest to `photo`, both [N, 3].

    Of several such maps the one with the smallest matrix.
    """
    count = len(render)
    of_render, of_photo = _sums(render), _sums(photo)
    within = _spread(render.T @ render, of_render, of_render, count)
    across = _spread(render.T @ photo, of_render, of_photo, count)
    matrix = np.linalg.pinv(within, rcond=_FLAT, hermitian=True) @ across
    means = (np.array(sums, dtype=np.float64) / count for sums in (of_render, of_photo))
    mean_render, mean_photo = means
    return matrix, mean_photo - mean_render @ matrix


def _sums(pixels: Floats) -> list[int]:
    return [int(value) for value in pixels.sum(axis=0)]


def _spread(products: Floats, first: list[int], second: list[int], count: int) -> Floats:
    """[3, 3] covariances, from sums of products and sums.

    Sums of products of 8-bit values are exact in float64 in any order; their differences are taken
    in integers, so that neither rounding nor the number of threads shows.
    """
    exact = [
        [count * int(products[i, j]) - first[i] * second[j] for j in range(3)] for i in range(3)
    ]
    return np.array([[value / count**2 for value in row] for row in exact])
