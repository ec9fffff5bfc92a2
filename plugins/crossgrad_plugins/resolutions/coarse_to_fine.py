"""Base of the resolutions that begin with small photos and end with the full size."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
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
from crossgrad_plugins.resolutions.course import Course

#: A photo that would be reduced by less has its full size: there is hardly a pixel to save.
FULL_FROM = 0.95
_REACHED = "reached"


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
