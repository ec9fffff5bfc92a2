"""The recipe slot: a component decides every setting that the user leaves open."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.schedule import (
    REFERENCE,
    Counting,
    Schedule,
    ScheduleMode,
    Unit,
    ViewsPerStepSpec,
    is_published,
)
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier


@dataclass(frozen=True, eq=False)
class Facts:
    """The facts about a run from which a recipe makes its decisions.

    Attributes:
        device: Torch device type.
        planned: Planned number of steps; None while only the time budget is known.
        total: Present number of steps. The number differs from `planned` if a time budget made the
            run longer or shorter.
        mode: `scaled` if the published schedule is stretched to the run, else `absolute`.
        schedule_length: Length for which the schedule is written. If None, a scaled schedule uses
            the length of the run, and an absolute schedule uses the published length.
        views_per_step: Number of views of each step, K.
        views_because: Reason why K differs from the sampler's default; empty if K is the default.
        photos: Number of training photos.
        pixels: Mean number of pixels of a training photo.
        photos_per_point: Median number of training photos that show an SfM point; 0 without points.
        own_points: True if the run starts from the points of the scene.
        batched: True if learning rates and Adam's decay rates are scaled with K.
        scale: Local units per unit of the scene's input frame.
        start: Number of primitives at the start; None before they are counted.
        backbone: The backbone, fitted to the scene.
        densifier: Name -> the densifier of this name with the options that the user set.
        provides: Screen statistics that the rasterizer of the run provides.
        given: The settings that the user set, with their values.
    """

    device: str
    planned: int | None
    total: int
    mode: ScheduleMode
    schedule_length: int | None
    views_per_step: ViewsPerStepSpec
    views_because: str
    photos: int
    pixels: float
    photos_per_point: float
    own_points: bool
    batched: bool
    scale: float
    start: int | None
    backbone: Backbone
    densifier: Callable[[str], Densifier]
    provides: frozenset[str]
    given: Mapping[str, Any]

    @property
    def published(self) -> bool:
        """True if the schedule uses the published numbers in a run of any length."""
        return is_published(self.mode, self.schedule_length)

    @property
    def unit(self) -> Unit:
        """The unit in which the schedule counts, unless the recipe chooses another unit."""
        unit: Unit = self.given.get("schedule_unit") or ("steps" if self.published else "views")
        return unit

    @property
    def steps(self) -> int | None:
        """Planned steps; with `--schedule absolute`, the number of steps of the schedule."""
        schedule = self.schedule(self.unit)
        if self.mode == "absolute":
            return schedule.step_of(schedule.length)
        return self.planned

    def intervals(self) -> list[Decision]:
        """Return the decisions on the intervals of evaluations and checkpoints."""
        steps = self.planned or self.total
        return [
            Decision("eval_every", max(1, steps // 10), "a tenth of the run"),
            Decision("save_every", max(1, steps // 5), "a fifth of the run"),
        ]

    @property
    def views(self) -> int | None:
        """Planned number of rendered views; None before the length of the run is planned."""
        steps = self.steps
        return None if steps is None else self.views_per_step.paced(steps).views(steps)

    @property
    def short(self) -> bool:
        """True if the run is shorter than the published runs, or has no planned length yet."""
        return self.views is None or self.views < REFERENCE

    def schedule(self, unit: Unit) -> Schedule:
        """Return the schedule for the present length of the run, without the recipe's decisions."""
        counting = Counting(unit, self.views_per_step, self.photos, self.schedule_length)
        return Schedule.for_run(self.total, self.mode, counting)


class Recipe(Component):
    """A set of rules that decides every setting that the user leaves open.

    Attributes:
        settings: Settings that the recipe fixes before any fact is known, such as the sampler and
            the length. The user's settings override these settings.
        rasterizer_options: Options that `--rasterizer auto` requires of a rasterizer for this
            recipe.
    """

    slot: ClassVar[str] = "recipes"
    settings: ClassVar[Mapping[str, Any]] = {}
    rasterizer_options: ClassVar[frozenset[str]] = frozenset()

    @abstractmethod
    def decide(self, facts: Facts) -> list[Decision]:
        """Return one decision for each setting; decisions on settings of the user are ignored."""


def with_rows(rows: Iterable[Decision], others: Sequence[Decision]) -> list[Decision]:
    """Return `rows`, updated by `others`: a row replaces the row of its setting or is appended."""
    table = {row.setting: row for row in rows}
    return [*(table | {row.setting: row for row in others}).values()]
