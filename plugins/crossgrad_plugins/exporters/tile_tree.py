"""Levels of detail: a tree of tiles whose inner tiles contain merged Gaussians."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crossgrad_plugins.exporters.ply_cloud import SplatCloud
from crossgrad_plugins.exporters.spz_file import unit_quaternions

#: Most Gaussians of a tile.
MOST: Final = 50_000
#: Children of a tile, and the number of Gaussians that become one in their parent.
_CHILDREN: Final = 8
#: Binary digits per axis of the order in which neighbours are merged.
_DIGITS: Final = 16
#: A box contains this many standard deviations of each Gaussian, in any direction.
_DEVIATIONS: Final = 3.0
_LARGEST_OPACITY: Final = 1.0 - 2.0**-24
_SMALLEST_VARIANCE: Final = 1e-30


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the Gaussians, and its parts.

    Attributes:
        name: Digits that lead to the part from the root, such as `0-3-1`.
        rows: The rows of its Gaussians.
        children: The parts; empty for a leaf.
    """

    name: str
    rows: NDArray[np.int64]
    children: "tuple[Part, ...]" = ()

    @classmethod
    def of(cls, means: NDArray[np.float64], rows: NDArray[np.int64], name: str = "0") -> "Part":
        """Divide the Gaussians `rows` of `means` [N, 3] until a part fits into a tile."""
        if len(rows) <= MOST:
            return cls(name, rows)
        parts = enumerate(_divided(means, rows))
        return cls(name, rows, tuple(cls.of(means, part, f"{name}-{n}") for n, part in parts))

    def leaves(self) -> "Iterator[Part]":
        """Yield the leaves, which together contain each row once."""
        if not self.children:
            yield self
        for child in self.children:
            yield from child.leaves()


@dataclass(frozen=True, eq=False)
class Tile:
    """A tile, whose Gaussians are shown until its children are loaded.

    Attributes:
        name: The name of its part.
        box: [2, 3] smallest and largest coordinates of the tile and its children.
        children: The tiles with more detail; empty for a leaf.
    """

    name: str
    box: NDArray[np.float64]
    children: "tuple[Tile, ...]" = ()


def written_tiles(
    cloud: SplatCloud, part: Part, write: Callable[[str, SplatCloud], None]
) -> tuple[Tile, SplatCloud]:
    """Write the tiles of a part with at least one Gaussian.

    Args:
        cloud: All Gaussians.
        part: The part.
        write: Writes a tile with this name and these Gaussians.

    Returns:
        The tile of the part, and its Gaussians.
    """
    tiles: tuple[Tile, ...] = ()
    if not part.children:
        content = cloud.selected(part.rows)
    else:
        below = [written_tiles(cloud, child, write) for child in part.children]
        together = SplatCloud.joined([gaussians for _, gaussians in below])
        content = merged(together)
        tiles = tuple(tile for tile, _ in below)
    write(part.name, content)
    corners = np.stack([_box(content), *(tile.box for tile in tiles)])
    box = np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    return Tile(part.name, box, tiles), content


def _divided(means: NDArray[np.float64], rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Divide rows into up to 8 parts of similar size, each at the median of its longest axis."""
    parts = [rows]
    while len(parts) < _CHILDREN and max(map(len, parts)) > MOST:
        halves = []
        for part in parts:
            if len(part) <= MOST:
                halves.append(part)
                continue
            points = means[part]
            # The standard deviation ignores single Gaussians far away better than the extent.
            axis = int(points.std(axis=0).argmax())
            middle = len(part) // 2
            order = np.argpartition(points[:, axis], middle)
            halves += [np.sort(part[order[:middle]]), np.sort(part[order[middle:]])]
        parts = halves
    return parts


def merged(cloud: SplatCloud) -> SplatCloud:
    """Return one Gaussian in place of each 8 neighbours.

    A Gaussian has the mean, the covariance and the colour of the Gaussians that it replaces. Their
    weights are opacity times area. Its opacity times area is the sum of theirs, so that it covers
    as much of an image.
    """
    order = np.argsort(_morton(cloud.means), kind="stable")
    missing = -len(order) % _CHILDREN
    order = np.append(order, order[-1:].repeat(missing))
    near = cloud.selected(order)
    sizes = np.exp(near.log_scales.astype(np.float64))
    with np.errstate(over="ignore"):
        weights = _areas(sizes) / (1.0 + np.exp(-near.logit_opacities)) + _SMALLEST_VARIANCE
    weights[len(weights) - missing :] = 0.0  # These rows only fill the last group.
    weights = weights.reshape(-1, _CHILDREN)
    total = weights.sum(axis=1)
    weights /= total[:, None]

    def mean(values: NDArray[Any]) -> NDArray[Any]:
        groups = values.reshape(len(total), _CHILDREN, -1)
        means = np.einsum("gk,gkc->gc", weights.astype(values.dtype), groups)
        return np.asarray(means.reshape(-1, *values.shape[1:]))

    means = mean(near.means)
    axes = Rotation.from_quat(unit_quaternions(near.quats)).as_matrix() * sizes[:, None]
    away = near.means - means.repeat(_CHILDREN, axis=0)
    covariances = mean(axes @ axes.transpose(0, 2, 1) + away[:, :, None] * away[:, None, :])
    variances, vectors = np.linalg.eigh(covariances)
    vectors[:, :, 0] *= np.linalg.det(vectors)[:, None]
    sizes = np.sqrt(np.maximum(variances, _SMALLEST_VARIANCE))
    opacities = np.clip(total / _areas(sizes), 1.0 - _LARGEST_OPACITY, _LARGEST_OPACITY)
    return SplatCloud(
        means=means,
        log_scales=np.log(sizes).astype(np.float32),
        quats=Rotation.from_matrix(vectors).as_quat()[:, [3, 0, 1, 2]].astype(np.float32),
        logit_opacities=np.log(opacities / (1.0 - opacities)).astype(np.float32),
        sh_dc=mean(near.sh_dc),
        sh_rest=mean(near.sh_rest),
        render_mode=cloud.render_mode,
    )


def _areas(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [N] the products of the two largest of three sizes [N, 3]."""
    ordered = np.sort(sizes, axis=1)
    return np.asarray(ordered[:, 1] * ordered[:, 2])


def _morton(means: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return [N] numbers in whose order neighbours follow each other, the Z-order curve."""
    low, high = np.quantile(means, [0.01, 0.99], axis=0)
    step = max(float((high - low).max()), 1e-30) / (2**_DIGITS - 1)
    cells = np.clip((means - low) / step, 0, 2**_DIGITS - 1).astype(np.int64)
    codes = np.zeros(len(means), dtype=np.int64)
    for digit in range(_DIGITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> digit) & 1) << (3 * digit + axis)
    return codes


def _box(cloud: SplatCloud) -> NDArray[np.float64]:
    """Return [2, 3] a box that contains Gaussians, at least one."""
    reach = _DEVIATIONS * np.exp(cloud.log_scales.max(axis=1, keepdims=True).astype(np.float64))
    return np.stack([(cloud.means - reach).min(axis=0), (cloud.means + reach).max(axis=0)])
