"""Base class of the resolutions that start with reduced photos and end with photos at full size."""

from abc import abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf
from typing import cast

from typing_extensions import override

from crossgrad_core.plugin import (
    Camera,
    Field,
    Json,
    PluginState,
    Resolution,
    ScaleContext,
    Scene,
    Schedule,
)

#: A scale of at least this value is replaced by full size, because it would hardly save any pixels.
FULL_FROM = 0.95
_REACHED = "reached"
#: Largest share of the run after which all views have full size, even if density control lasts
#: longer.
LATEST = 0.9
#: Without density control, all views have full size after this share of the run.
USUAL = 0.5


@dataclass(frozen=True)
class Course:
    """A sequence of increasing scales for photos, followed by full size.

    Attributes:
        ends: Shares of the window, at most 1, at which each scale ends, in ascending order.
        scales: One scale in (0, 1) for each entry of `ends`, in ascending order.
    """

    ends: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()

    @classmethod
    def of_parts(cls, scales: Sequence[float]) -> "Course":
        """Return a course that divides the window equally among the scales."""
        count = len(scales)
        return cls(tuple((stage + 1) / count for stage in range(count)), tuple(scales))

    @classmethod
    def of_stages(cls, stages: Iterable[tuple[float, float]]) -> "Course":
        """Return a course of stages.

        A stage is the share of the window at which it ends, and its scale.
        """
        return cls(*map(tuple, zip(*stages, strict=True)))

    def at(self, progress: float) -> float:
        """Return the scale that follows a share of the window."""
        stage = bisect_right(self.ends, progress)
        return self.scales[stage] if stage < len(self.scales) else 1.0

    def pixels(self, progress: float) -> float:
        """Return the sum of rendered pixels up to a share of the window.

        The unit is the number of pixels of a photo at full size. The sum is the integral of the
        squared scale. The share may be above 1.
        """
        borders = [min(end, progress) for end in (0.0, *self.ends)]
        parts = zip(pairwise(borders), self.scales, strict=True)
        reduced = sum((end - start) * scale**2 for (start, end), scale in parts)
        return reduced + progress - borders[-1]

    def text(self, schedule: Schedule, window: float) -> str:
        """Return a text with the scales by step, for a window that ends at a given count."""
        if not self.scales:
            return "full size"
        scales = (*self.scales, 1.0)
        starts = [schedule.step_of(ceil(end * window)) + 1 for end in (0.0, *self.ends)]
        texts = [f"1/{1 / scales[0]:.3g} to step {starts[bisect_right(scales, scales[0])] - 1}"]
        for octave in (0.25, 0.5):
            stage = bisect_left(scales, octave)
            if scales[0] < octave and scales[stage] < 1.0:
                texts.append(f"1/{1 / octave:g} from step {starts[stage]}")
        return ", ".join((*texts, f"full size from step {starts[-1]}"))


@dataclass(frozen=True)
class Part:
    """A course, and the number of photos that use it."""

    course: Course
    photos: int = 1


class CoarseToFine(Resolution):
    """Renders and compares small photos first, then larger photos.

    A scale never decreases. If the planned end of a run changes, a course could go back to a
    smaller scale; the state therefore stores the largest scale that each course has reached.
    """

    smallest: int = Field(
        96, ge=1, description="minimum number of pixels of the shorter side of a render"
    )

    @abstractmethod
    def window(self, schedule: Schedule) -> float:
        """Return the number of views or steps after which all views have full size, or 0."""

    @abstractmethod
    def parts(self) -> Mapping[str, Part]:
        """Return the course of each regime.

        A regime without a course uses the first course. If there are no courses, all views have
        full size.
        """

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        parts = self.measured(context.scene).parts()
        window = self.window(context.schedule)
        progress = context.schedule.counted(context.step - 1) / window if window else inf
        reached = dict(cast("Mapping[str, float]", state.values.get(_REACHED, {})))
        view_scales = []
        for view in context.views:
            regime = view.regime if view.regime in parts else next(iter(parts), "")
            scale = parts[regime].course.at(progress) if parts else 1.0
            reached[regime] = scale = max(scale, reached.get(regime, 0.0))
            view_scales.append(self.of_photo(view.camera, scale))
        return tuple(view_scales), PluginState({_REACHED: cast("Json", reached)})

    def measured(self, scene: Scene) -> "CoarseToFine":
        """Return the resolution fitted to the scene.

        A run calls this function before the first step.
        """
        return cast("CoarseToFine", self.fitted_to(scene))

    @override
    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        window = self.window(schedule)
        texts = {name: part.course.text(schedule, window) for name, part in self.parts().items()}
        lines = [text if len(texts) == 1 else f"{name} {text}" for name, text in texts.items()]
        return (f"resolution: {'; '.join(lines)}",) if lines else ()

    @override
    def pixels(self, schedule: Schedule, step: int) -> float:
        window = self.window(schedule)
        if not window:
            return super().pixels(schedule, step)
        progress = schedule.counted(step) / window
        parts = self.parts().values()
        every = progress * sum(part.photos for part in parts)
        rendered = sum(part.photos * part.course.pixels(progress) for part in parts)
        return schedule.pace.views(step) * (rendered / every if every else 1.0)

    def of_photo(self, camera: Camera, scale: float) -> float:
        """Return the scale, or a larger scale if the photo would otherwise have too few pixels."""
        least = self.smallest / min(camera.width, camera.height)
        return 1.0 if max(scale, least) >= FULL_FROM else max(scale, least)


def window_of(schedule: Schedule, until: float | None) -> float:
    """Return the number of views or steps after which every view has full size.

    Args:
        schedule: The schedule of the run.
        until: Share of the run after which every view has full size. None means the end of density
            control, or half of the run if there is no density control.
    """
    whole = schedule.counted(schedule.total)
    if until is not None:
        return until * whole
    return min(float(schedule.densify_until), LATEST * whole) if schedule.grows else USUAL * whole
