"""Scales that follow the spectrum of the photos (DashGaussian)."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Field, Scene, Schedule, View
from crossgrad_plugins.resolutions.coarse_to_fine import CoarseToFine, Course, Part, window_of

#: Maximum number of photos whose spectrum is measured, over all regimes together.
MOST_PHOTOS = 32
#: Regimes get separate scale courses if their shares of the spectrum that a scale keeps differ by
#: more than this.
ALIKE = 0.05
#: Name of the scale course that applies to all photos.
ALL = "all"
#: Number of scales, from 1 / GRID to 1, at which the kept shares of the spectrum are measured.
GRID = 256
#: Largest side in pixels of the window in the middle of a photo that is analysed. In a cropped
#: photo, a scale keeps the same share of the spectrum as in the whole photo. In a smaller copy of
#: the photo, the scale keeps another share.
_WINDOW = 1024
#: Number of photos that are decoded at once. More photos would need too much memory.
_AT_ONCE = 2
#: Tolerance for a frequency that a scale just keeps, because the frequency may have been rounded
#: up.
_ROUNDING = 1e-9
Floats = NDArray[np.float64]


class Scales(BaseModel):
    """The scales of some photos, as written to config.yaml."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    photos: int = Field(ge=1, description="training photos")
    scales: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        description="number of equal stages in the window; after it, full size"
    )


class Spectral(CoarseToFine):
    """Keeps photos small as long as the small size contains most of their spectrum.

    X(F_r) is the sum of the amplitudes of the frequencies that photos at 1 / r of the size contain.
    A run begins with the r at which X(F_r) = X(F) / ratio. The run changes from an r to the next
    finer r after the share X(F_r) / X(F) of the window. Between the levels of r, the number of
    pixels grows linearly.

    Source: DashGaussian (arXiv 2503.18402).
    """

    ratio: float = Field(
        4.0, gt=1, description="the first scale keeps at least 1 / ratio of the spectrum"
    )
    coarsest: float = Field(4.0, ge=1, description="the first scale is at least 1 / coarsest")
    levels: int = Field(
        32, ge=1, le=GRID, description="levels of the spectrum, and stages in the window"
    )
    until: float | None = Field(
        None,
        gt=0,
        le=1,
        description="share of the run after which photos have their full size; null: the end of "
        "density control, or half of the run without density control",
    )
    per_regime: Literal["auto", "always", "never"] = Field(
        "auto", description="whether each regime has its own scales; auto: if spectra differ"
    )
    courses: Mapping[str, Scales] | None = Field(
        None, description="scales by regime; null: they are measured and saved"
    )

    @override
    def fitted_to(self, scene: Scene) -> "Spectral":
        if self.courses is not None:
            return self
        groups = self._groups(scene)
        courses = {
            name: Scales(photos=len(group.views), scales=self._scales(group))
            for name, group in groups.items()
        }
        return self.model_copy(update={"courses": courses})

    @override
    def window(self, schedule: Schedule) -> float:
        return window_of(schedule, self.until)

    @override
    def parts(self) -> Mapping[str, Part]:
        courses = self.courses or {}
        return {
            name: Part(_course(course.scales), course.photos) for name, course in courses.items()
        }

    def _groups(self, scene: Scene) -> Mapping[str, "_Group"]:
        """Return the groups of photos that share a course, by name."""
        views = scene.train_views
        regimes = sorted({view.regime for view in views}) if self.per_regime != "never" else []
        if len(regimes) > 1:
            most = max(1, MOST_PHOTOS // len(regimes))
            apart = {
                regime: _Group.of([v for v in views if v.regime == regime], most)
                for regime in regimes
            }
            kept = [group.kept for group in apart.values()]
            if self.per_regime == "always" or np.ptp(kept, axis=0).max() > ALIKE:
                return apart
        return {ALL: _Group.of(views, MOST_PHOTOS)}

    def _scales(self, group: "_Group") -> tuple[float, ...]:
        """Return the scales in equal parts of the window; empty if full size is needed at once."""
        scales = np.arange(GRID + 1) / GRID
        least = min(1.0, max(1.0 / self.coarsest, self.smallest / group.shorter))
        first = int(np.argmax((scales >= least) & (group.kept >= 1.0 / self.ratio)))
        if first == GRID:
            return ()
        levels = np.unique(np.linspace(first, GRID, self.levels + 1).round().astype(int))
        ends, pixels = group.kept[levels], scales[levels] ** 2
        parts = np.arange(self.levels) / self.levels
        # `ahead` is the level that the run leaves next.
        ahead = np.searchsorted(ends, parts, side="right")
        behind = np.maximum(ahead - 1, 0)
        # Before the first level is left, there is no level to interpolate from.
        share = (parts - ends[behind]) / np.where(ahead > 0, ends[ahead] - ends[behind], np.inf)
        areas = pixels[behind] + share * (pixels[ahead] - pixels[behind])
        return tuple(np.sqrt(areas).round(4).tolist())


@dataclass(frozen=True, eq=False)
class _Group:
    """A group of photos that share a course.

    Attributes:
        views: The views of the photos.
        kept: [GRID + 1] share of the spectrum that the scales 0, 1 / GRID .. 1 keep.
        shorter: Median of the shorter side, in pixels.
    """

    views: Sequence[View]
    kept: Floats
    shorter: float

    @classmethod
    def of(cls, views: Sequence[View], most: int) -> "_Group":
        """Return the group of `views`; at most `most` spectra, evenly spread, are measured."""
        chosen = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
        shorter = [min(view.camera.width, view.camera.height) for view in views]
        kept = kept_shares([views[index] for index in chosen])
        return cls(views, kept, float(np.median(shorter)))


@lru_cache
def _course(scales: tuple[float, ...]) -> Course:
    return Course.of_parts(scales)


def kept_shares(views: Sequence[View]) -> Floats:
    """Return [GRID + 1] X(F_r) / X(F) at scales 0, 1 / GRID .. 1: the share of the spectrum kept.

    X(F) is the sum of the amplitudes |DFT| of the grey photos. X(F_r) is the sum over the
    frequencies that a photo at 1 / r of the size contains: at most 1 / r of the highest frequency,
    in x and in y. Each photo is processed by one thread, and sums are in the order of the photos,
    so the result does not depend on the number of threads. For photos whose amplitudes are all
    zero, the share is 1 at every scale.

    Args:
        views: The views, at least one.

    Raises:
        UserError: A photo cannot be decoded.

    Source: DashGaussian (arXiv 2503.18402).
    """
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        sums = np.sum(list(pool.map(_of_view, views)), axis=0)
    return np.asarray(sums / sums[-1] if sums[-1] > 0.0 else np.ones(GRID + 1))


def _of_view(view: View) -> Floats:
    photo = view.photo
    return amplitudes_within(grey_window(photo.image(), photo.mask()))


def grey_window(image: Tensor, mask: Tensor | None) -> Floats:
    """Return [h, w] the middle of a photo in grey, 0 to 255; masked pixels get the mean.

    Args:
        image: [H, W, 3] uint8.
        mask: [H, W] bool; None if every pixel counts.
    """
    top, left = (max(0, (size - _WINDOW) // 2) for size in image.shape[:2])
    window = slice(top, top + _WINDOW), slice(left, left + _WINDOW)
    grey = np.asarray(image[window].numpy().mean(axis=2, dtype=np.float64))
    if mask is not None:
        counts = mask[window].numpy()
        grey[~counts] = grey[counts].mean() if counts.any() else 0.0
    return grey


def amplitudes_within(grey: Floats) -> Floats:
    """Return [GRID + 1] the sum of the amplitudes |DFT| of the frequencies that each scale keeps.

    Args:
        grey: [H, W] photo.
    """
    height, width = grey.shape
    amplitudes = np.abs(np.fft.rfft2(grey))
    # For a real image, the other half of the spectrum has equal amplitudes, so double these
    # columns. Exceptions are the first column and, if the number of columns is even, the last
    # column.
    amplitudes[:, 1 : (width + 1) // 2] *= 2.0
    cells = np.maximum.outer(_cells(np.fft.fftfreq(height)), _cells(np.fft.rfftfreq(width)))
    return np.cumsum(np.bincount(cells.ravel(), amplitudes.ravel(), GRID + 1))


def _cells(frequencies: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the first scale index that keeps each frequency, cycles per pixel in [-1/2, 1/2]."""
    return np.asarray(np.ceil(2.0 * GRID * np.abs(frequencies) - _ROUNDING), dtype=np.int64)
