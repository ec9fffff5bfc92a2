"""Scales that follow the amplitude spectrum of the photos (DashGaussian)."""

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

#: Maximum number of photos whose spectrum is measured, in all regimes together.
MOST_PHOTOS = 32
#: Two regimes get separate courses of scales if their kept shares of the spectrum differ by more
#: than this value.
ALIKE = 0.05
#: Name of the scale course that applies to all photos.
ALL = "all"
#: Number of scales, from 1 / GRID to 1, for which the kept share of the spectrum is measured.
GRID = 256
#: Only a window in the middle of a photo is analysed; this is its largest side, in pixels. The
#: photo is cropped and not reduced, because the crop keeps the relation between a scale and the
#: share of the spectrum.
_WINDOW = 1024
#: Number of photos that are decoded at the same time. More photos would need too much memory.
_AT_ONCE = 2
#: Tolerance for the comparison of a frequency with the limit of a scale, because frequencies are
#: rounded.
_ROUNDING = 1e-9
Floats = NDArray[np.float64]


class Scales(BaseModel):
    """The course of scales for a group of photos, as written to config.yaml."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    photos: int = Field(ge=1, description="training photos")
    scales: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(
        description="number of equal stages in the window; after it, full size"
    )


class Spectral(CoarseToFine):
    """Renders reduced photos as long as the reduced size contains most of the photos' spectrum.

    Let F be all frequencies and F_r the frequencies that a photo at 1 / r of its size contains. X
    is the sum of the amplitudes of a set of frequencies. A run starts with the reduction r at which
    X(F_r) = X(F) / ratio. The run changes from r to the next smaller r after the share X(F_r) /
    X(F) of the window. Between two values of r, the number of pixels grows linearly.

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
        """Return groups of photos by name; the photos of a group have one course of scales."""
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
        """Return the scales for equal parts of the window.

        The result is empty if full size is needed at once.
        """
        scales = np.arange(GRID + 1) / GRID
        least = min(1.0, max(1.0 / self.coarsest, self.smallest / group.shorter))
        first = int(np.argmax((scales >= least) & (group.kept >= 1.0 / self.ratio)))
        if first == GRID:
            return ()
        levels = np.unique(np.linspace(first, GRID, self.levels + 1).round().astype(int))
        ends, pixels = group.kept[levels], scales[levels] ** 2
        parts = np.arange(self.levels) / self.levels
        # `ahead` is the next level that the run has to reach.
        ahead = np.searchsorted(ends, parts, side="right")
        behind = np.maximum(ahead - 1, 0)
        # Before the first level, there is no earlier level for the interpolation.
        share = (parts - ends[behind]) / np.where(ahead > 0, ends[ahead] - ends[behind], np.inf)
        areas = pixels[behind] + share * (pixels[ahead] - pixels[behind])
        return tuple(np.sqrt(areas).round(4).tolist())


@dataclass(frozen=True, eq=False)
class _Group:
    """A group of photos that have one course of scales.

    Attributes:
        views: The views of the group.
        kept: [GRID + 1] share of the spectrum that each of the scales 0, 1 / GRID .. 1 keeps.
        shorter: Median of the photos' shorter side, in pixels.
    """

    views: Sequence[View]
    kept: Floats
    shorter: float

    @classmethod
    def of(cls, views: Sequence[View], most: int) -> "_Group":
        """Return the group of `views`.

        The spectrum is measured for at most `most` views, at even intervals.
        """
        chosen = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
        shorter = [min(view.camera.width, view.camera.height) for view in views]
        kept = kept_shares([views[index] for index in chosen])
        return cls(views, kept, float(np.median(shorter)))


@lru_cache
def _course(scales: tuple[float, ...]) -> Course:
    return Course.of_parts(scales)


def kept_shares(views: Sequence[View]) -> Floats:
    """Return [GRID + 1] the share of the spectrum that each scale keeps.

    The scales are 0, 1 / GRID .. 1, and the share at scale 1 / r is X(F_r) / X(F). X(F) is the sum
    of the amplitudes |DFT| over all frequencies of the grey photos. X(F_r) is the sum over the
    frequencies up to 1 / r of the highest frequency, in x and in y. A photo at 1 / r of the size
    contains these frequencies. Each photo is processed by one thread, and the sums follow the order
    of the photos. The result therefore does not depend on the number of threads. If all amplitudes
    of the photos are zero, the share is 1 at every scale.

    Args:
        views: The views; at least one is needed.

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
    """Return [h, w] the middle of a photo in grey, 0 to 255; masked pixels get the mean grey value.

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
    """Return [GRID + 1] the sums of the amplitudes |DFT| of the frequencies that each scale keeps.

    Args:
        grey: [H, W] grey photo.
    """
    height, width = grey.shape
    amplitudes = np.abs(np.fft.rfft2(grey))
    # The transform of a real image stores only half of the columns; the other half has equal
    # amplitudes. Count each column twice. Count the first column once, and also the last column if
    # the number of columns is even.
    amplitudes[:, 1 : (width + 1) // 2] *= 2.0
    cells = np.maximum.outer(_cells(np.fft.fftfreq(height)), _cells(np.fft.rfftfreq(width)))
    return np.cumsum(np.bincount(cells.ravel(), amplitudes.ravel(), GRID + 1))


def _cells(frequencies: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the index of the first scale that keeps each frequency.

    Frequencies are in cycles per pixel, [-1/2, 1/2].
    """
    return np.asarray(np.ceil(2.0 * GRID * np.abs(frequencies) - _ROUNDING), dtype=np.int64)
