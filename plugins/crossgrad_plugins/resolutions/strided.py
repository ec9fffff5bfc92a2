"""Some pixels of each photo for most of the run, all pixels at its end."""

from collections.abc import Mapping
from math import ceil, isqrt
from statistics import median
from typing import ClassVar, Literal

from typing_extensions import override

from crossgrad_core.plugin import Camera, Field, Scene, Schedule, listed, shortness
from crossgrad_plugins.resolutions.coarse_to_fine import CoarseToFine, Course, Part

#: Share of a short run in which only a part of the pixels is rendered, at most one pixel of each 2
#: x 2. In longer runs, the share is smaller.
_SHARE = 0.8
#: Shares of this window. Until the first share, one pixel of each 8 x 8 is rendered. Until the
#: second share, one pixel of each 4 x 4 is rendered.
_EIGHTH, _QUARTER = 0.3, 0.6


class Strided(CoarseToFine):
    """Renders one pixel of each n x n block up to a share of the run, a new pixel in each step.

    Photos are not reduced. The rendered pixels have the same values as in the full render. So the
    gradients of a per-pixel error are unbiased. This schedule was developed for crossgrad.
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
        # If the user sets n, it is used for all photos that are large enough for it.
        n = median(most) if self.coarsest is None else min(self.coarsest, max(most))
        return self.model_copy(
            update={"coarsest": max(stride for stride in (1, 2, 4, 8) if stride <= n)}
        )

    @override
    def measured(self, scene: Scene) -> CoarseToFine:
        # Use the stored value. This function is called in each step, and examining all photos again
        # would take too long.
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
        """Return the largest n that a photo allows."""
        by_side = min(camera.width, camera.height) // self.smallest
        return max(1, min(by_side, isqrt(camera.width * camera.height // self.least)))
