"""Photos at 1/4 of their size, then at 1/2, then at full size."""

from collections.abc import Mapping
from typing import Self

from pydantic import model_validator
from typing_extensions import override

from crossgrad_core.plugin import Field, Schedule
from crossgrad_plugins.resolutions.coarse_to_fine import CoarseToFine, Course, Part


class Octaves(CoarseToFine):
    """Renders photos at 1/4 of their size first, then at 1/2, then at full size.

    This schedule was developed for crossgrad.
    """

    quarter_until: float = Field(
        0.2, ge=0, lt=1, description="share of the run at 1/4 of the size; 0: none"
    )
    half_until: float = Field(
        0.4, ge=0, le=0.95, description="share of the run after which photos have their full size"
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.half_until < self.quarter_until:
            raise ValueError("half_until must be at least quarter_until")
        return self

    @override
    def window(self, schedule: Schedule) -> float:
        return schedule.counted(schedule.total)

    @override
    def parts(self) -> Mapping[str, Part]:
        stages = ((0.0, self.quarter_until, 0.25), (self.quarter_until, self.half_until, 0.5))
        there = [(end, scale) for start, end, scale in stages if start < end]
        return {"all": Part(Course.of_stages(there))}

    @override
    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        return tuple(
            f"{text}; no side has fewer than {self.smallest} pixels"
            for text in super().messages(schedule)
        )
