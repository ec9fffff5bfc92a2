"""Square cells over a photo and beyond its edges: their mean colours and their coverage."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera, View

#: Radius of the disc that a Gaussian covers in a photo, in standard deviations.
_WITHIN = 2.0
#: Largest radius of the disc of a Gaussian, as a share of the photo's longer side. Training soon
#: shrinks a larger Gaussian, or its point is wrong.
_LARGEST = 1.0 / 8.0
#: A cell counts as covered if the discs of small Gaussians fill at least this share of its area.
_COVERED = 0.5


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of one size over a photo and a margin around it.

    Attributes:
        camera: The photo's camera.
        size: Side of a cell, pixels.
        margin: Number of cells beyond each edge of the photo.
    """

    camera: Camera
    size: float
    margin: int

    @property
    def inner(self) -> tuple[int, int]:
        """Number of rows and columns of cells that are at least partly on the photo."""
        return int(np.ceil(self.camera.height / self.size)), int(
            np.ceil(self.camera.width / self.size)
        )

    @cached_property
    def places(self) -> NDArray[np.int64]:
        """[C, 2] column and row of each cell; the photo's first cell is (0, 0)."""
        rows, columns = (np.arange(-self.margin, count + self.margin) for count in self.inner)
        down, across = np.meshgrid(rows, columns, indexing="ij")
        return np.column_stack([across.ravel(), down.ravel()])

    @cached_property
    def pixels(self) -> NDArray[np.float64]:
        """[C, 2] centres of the cells.

        If the centre of a cell on the photo is outside, it is moved to the edge.
        """
        middles = (self.places + 0.5) * self.size
        ends = np.array([self.camera.width, self.camera.height]) - 0.5
        return np.where(self.on_photo[:, None], np.minimum(middles, ends), middles)

    @cached_property
    def on_photo(self) -> NDArray[np.bool_]:
        """[C] True if a cell is on the photo."""
        rows, columns = self.inner
        across, down = self.places.T
        on_photo = (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        return np.asarray(on_photo, dtype=np.bool_)

    def colors(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the colour [C, 3] of each cell, and a flag [C].

        The colour is the mean of the nearest cell on the photo. The flag is True if the nearest
        cell contains unmasked pixels. Masked pixels do not enter the means.
        """
        photo = view.photo
        image, mask = photo.image().cpu().numpy(), photo.mask()
        counts = np.ones(image.shape[:2], dtype=np.uint8)
        if mask is not None:
            counts = mask.cpu().numpy().astype(np.uint8)
        pixels = self._sums(counts[..., None])
        means = self._sums(image * counts[..., None]) / np.maximum(pixels, 1)
        rows, columns = self.inner
        across = np.clip(self.places[:, 0], 0, columns - 1)
        down = np.clip(self.places[:, 1], 0, rows - 1)
        return means.round().astype(np.uint8)[down, across], pixels[down, across, 0] > 0

    def _sums(self, image: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """Return [rows, columns, channels] sums of an image [H, W, channels] over its cells."""
        down, across = (
            np.floor(np.arange(count) * self.size).astype(np.int64) for count in self.inner
        )
        lines = np.add.reduceat(image, down, axis=0, dtype=np.uint64)
        return np.asarray(np.add.reduceat(lines, across, axis=1))

    def covered(self, points: NDArray[np.float64], sizes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return [C], True if Gaussians cover the cell.

        Args:
            points: [P, 3] centres of the Gaussians.
            sizes: [P] standard deviations of the Gaussians.
        """
        pixels, depth = self.camera.project(points)
        radii = _WITHIN * sizes * self.camera.fx / np.where(depth > 0.0, depth, np.inf)
        radii = np.minimum(radii, _LARGEST * max(self.camera.width, self.camera.height))
        large = radii > self.size / 2.0
        small = (radii > 0.0) & ~large
        return self._under_small(pixels[small], radii[small]) | self._under_large(
            pixels[large], radii[large]
        )

    def _under_small(
        self, pixels: NDArray[np.float64], radii: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [C], True if the discs in a cell fill the share `_COVERED` of its area."""
        rows, columns = (count + 2 * self.margin for count in self.inner)
        across, down = np.floor(np.clip(pixels / self.size, -1e6, 1e6)).astype(np.int64).T
        across, down = across + self.margin, down + self.margin
        there = (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        cell = down[there] * columns + across[there]
        areas = np.bincount(cell, np.pi * radii[there] ** 2, minlength=rows * columns)
        return np.asarray(areas >= _COVERED * self.size**2)

    def _under_large(
        self, pixels: NDArray[np.float64], radii: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [C], True if a square with the area of a disc contains the cell's centre."""
        rows, columns = (count + 2 * self.margin for count in self.inner)
        half = (np.sqrt(np.pi) / 2.0 * radii / self.size)[:, None]
        middle = np.clip(pixels / self.size, -1e6, 1e6) + self.margin - 0.5
        ends = np.array([columns, rows])
        first = np.clip(np.ceil(middle - half), 0, ends).astype(np.int64)
        behind = np.maximum(np.clip(np.floor(middle + half) + 1, 0, ends).astype(np.int64), first)
        # Each square adds +1 or -1 at its four corners in a table of differences. The cumulative
        # sum of the table then counts the squares over each cell.
        steps = np.zeros((rows + 1, columns + 1), dtype=np.int64)
        for across, down, sign in (
            (first[:, 0], first[:, 1], 1),
            (behind[:, 0], behind[:, 1], 1),
            (first[:, 0], behind[:, 1], -1),
            (behind[:, 0], first[:, 1], -1),
        ):
            np.add.at(steps, (down, across), sign)
        table = steps.cumsum(axis=0).cumsum(axis=1)
        return np.asarray(table[:rows, :columns].ravel() > 0)
