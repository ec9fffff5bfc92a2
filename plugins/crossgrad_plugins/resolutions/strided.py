"""Renders of some pixels of each photo for most of the run, and of all pixels at its end."""

from collections.abc import Mapping
from math import ceil, isqrt
from statistics import median
from typing import ClassVar, Literal

from typing_extensions import override

from crossgrad_core.plugin import Camera, Field, Scene, Schedule, listed, shortness
from crossgrad_plugins.resolutions.coarse_to_fine import CoarseToFine, Course, Part

#: Share of a short run in which only some of the pixels are rendered. The share is smaller in
#: longer runs.
_SHARE = 0.8
#: Shares of this window at which the first two stages end. The first stage renders one pixel of
#: each 8 x 8 block. The second stage renders one pixel of each 4 x 4 block, and the rest of the
#: window one pixel of each 2 x 2 block.
_EIGHTH, _QUARTER = 0.3, 0.6


class Strided(CoarseToFine):
    """Renders one pixel of each n x n block up to a share of the run.

    The position of the pixel in the block is new in each step. The photos are not reduced in size.
    The rendered pixels have the same values as in a render of all pixels. The gradients of a
    per-pixel error are therefore unbiased. This schedule was developed for crossgrad.
    """

    strided: ClassVar[bool] = True

    until: float | None = Field(
        None,
        ge=0,
        le=0.95,
        description="share of the run after which all pixels are rendered; null: depends on its "
        "length",
    )
    least: int = Field(
        60_000, ge=1, description="minimum number of pixels of a render with a stride"
    )
    coarsest: Literal[1, 2, 4, 8] | None = Field(
        None, description="n of the first steps; null: depends on the photos' pixels, and is saved"
    )

    @override
    def fitted_to(self, scene: Scene) -> "Strided":
        most = [self._most(view.camera) for view in scene.train_views]
        # If the user sets n, it is used for all photos that are large enough.
        n = median(most) if self.coarsest is None else min(self.coarsest, max(most))
        return self.model_copy(
            update={"coarsest": max(stride for stride in (1, 2, 4, 8) if stride <= n)}
        )

    @override
    def measured(self, scene: Scene) -> CoarseToFine:
        # Use the stored value, because this function is called in each step. Examining all photos
        # again would take too long.
        return self if self.coarsest is not None else self.fitted_to(scene)

    @override
    def window(self, schedule: Schedule) -> float:
        whole = schedule.counted(schedule.total)
        if self.until is not None:
            return self.until * whole
        return _SHARE * shortness(whole) * whole

    @override
    def parts(self) -> Mapping[str, Part]:
        stages = ((_EIGHTH, 8), (_QUARTER, 4), (1.0, 2))
        there = [(end, 1.0 / n) for end, n in stages if n <= (self.coarsest or 1)]
        return {"all": Part(Course.of_stages(there))}

    @override
    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        (part,), window = self.parts().values(), self.window(schedule)
        stages = zip(part.course.ends, part.course.scales, strict=True)
        ends = [(schedule.step_of(ceil(end * window)), round(1.0 / scale)) for end, scale in stages]
        texts = [f"of each {n} x {n} to step {end}" for end, n in ends]
        if not texts:
            return (
                (
                    "resolution: all pixels from the start, because resolution.coarsest is 1: "
                    f"this is the maximum for photos with fewer than {4 * self.least:,} pixels or "
                    f"with a side of fewer than {2 * self.smallest} pixels"
                ),
            )
        if not window:
            why = "this share of the run is 0" if self.until == 0 else "the run is long"
            return (f"resolution: all pixels from the start: {why} (--set resolution.until=SHARE)",)
        return (
            (
                f"resolution: one pixel {listed(texts)}, another one in each step; then all "
                "pixels (--resolution full: from the start)"
            ),
        )

    @override
    def of_photo(self, camera: Camera, scale: float) -> float:
        return 1.0 / min(round(1.0 / scale), self._most(camera))

    def _most(self, camera: Camera) -> int:
        """Return the largest n that the size of a photo allows."""
        by_side = min(camera.width, camera.height) // self.smallest
        return max(1, min(by_side, isqrt(camera.width * camera.height // self.least)))
