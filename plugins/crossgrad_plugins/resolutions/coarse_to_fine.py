"""Base of the resolutions that begin with small photos and end with the full size."""

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

#: A photo that would be reduced by less has its full size: there is hardly a pixel to save.
FULL_FROM = 0.95
_REACHED = "reached"
#: Where density control goes on for longer, the window ends at this share of the run.
LATEST = 0.9
#: Without density control it ends here.
USUAL = 0.5


@dataclass(frozen=True)
class Course:
    """Scales one after the other, then full size.

    Attributes:
        ends: Shares of the window, at most 1, up to which each scale lasts; none is below another
            one before it.
        scales: As many scales in (0, 1); likewise.
    """

    ends: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()

    @classmethod
    def of_parts(cls, scales: Sequence[float]) -> "Course":
        """Scales that last equally long and fill the window together."""
        count = len(scales)
        return cls(tuple((part + 1) / count for part in range(count)), tuple(scales))

    @classmethod
    def of_stages(cls, stages: Iterable[tuple[float, float]]) -> "Course":
        """Scales with the share of the window at which each ends."""
        return cls(*map(tuple, zip(*stages, strict=True)))

    def at(self, progress: float) -> float:
        """The scale after that share of the window."""
        part = bisect_right(self.ends, progress)
        return self.scales[part] if part < len(self.scales) else 1.0

    def pixels(self, progress: float) -> float:
        """The sum of the pixels up to that share of the window, which may be over; 1 at full size.

        That is the integral of the squared scale.
        """
        borders = [min(end, progress) for end in (0.0, *self.ends)]
        parts = zip(pairwise(borders), self.scales, strict=True)
        reduced = sum((end - start) * scale**2 for (start, end), scale in parts)
        return reduced + progress - borders[-1]

    def text(self, schedule: Schedule, window: float) -> str:
        """The scales by step, of a run whose window is over at that count."""
        if not self.scales:
            return "full size"
        scales = (*self.scales, 1.0)
        starts = [schedule.step_of(ceil(end * window)) + 1 for end in (0.0, *self.ends)]
        told = [f"1/{1 / scales[0]:.3g} to step {starts[bisect_right(scales, scales[0])] - 1}"]
        for octave in (0.25, 0.5):
            part = bisect_left(scales, octave)
            if scales[0] < octave and scales[part] < 1.0:
                told.append(f"1/{1 / octave:g} from step {starts[part]}")
        return ", ".join((*told, f"full size from step {starts[-1]}"))


@dataclass(frozen=True)
class Part:
    """The course of some photos, and how many there are."""

    course: Course
    photos: int = 1


class CoarseToFine(Resolution):
    """Renders and compares small photos first, then larger ones.

    No scale falls again, also where the length of the run follows the clock and its end moves away:
    the largest scale that each course has reached is remembered.
    """

    smallest: int = Field(
        96, ge=1, description="pixels that the shorter side of a render has at least"
    )

    @abstractmethod
    def window(self, schedule: Schedule) -> float:
        """The count, of views or of steps, from which on every view has its full size; 0: all."""

    @abstractmethod
    def parts(self) -> Mapping[str, Part]:
        """The courses by regime; one that is not there has the first one, none the full size."""

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        parts = self.measured(context.scene).parts()
        window = self.window(context.schedule)
        progress = context.schedule.counted(context.step - 1) / window if window else inf
        reached = dict(cast("Mapping[str, float]", state.values.get(_REACHED, {})))
        found = []
        for view in context.views:
            regime = view.regime if view.regime in parts else next(iter(parts), "")
            scale = parts[regime].course.at(progress) if parts else 1.0
            reached[regime] = scale = max(scale, reached.get(regime, 0.0))
            found.append(self.of_photo(view.camera, scale))
        return tuple(found), PluginState({_REACHED: cast("Json", reached)})

    def measured(self, scene: Scene) -> "CoarseToFine":
        """Fitted to the scene, which a run has done before its first step."""
        return cast("CoarseToFine", self.fitted_to(scene))

    @override
    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        window = self.window(schedule)
        texts = {name: part.course.text(schedule, window) for name, part in self.parts().items()}
        told = [text if len(texts) == 1 else f"{name} {text}" for name, text in texts.items()]
        return (f"resolution: {'; '.join(told)}",) if told else ()

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
        """A scale that leaves a photo enough pixels."""
        least = self.smallest / min(camera.width, camera.height)
        return 1.0 if max(scale, least) >= FULL_FROM else max(scale, least)


def window_of(schedule: Schedule, until: float | None) -> float:
    """The count, of views or of steps, from which on every view has its full size.

    Args:
        schedule: The schedule of the run.
        until: A share of the run; None for the end of density control, half of the run where there
            is none.
    """
    whole = schedule.counted(schedule.total)
    if until is not None:
        return until * whole
    return min(float(schedule.densify_until), LATEST * whole) if schedule.grows else USUAL * whole
