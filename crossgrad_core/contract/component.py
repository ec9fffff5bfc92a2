"""Components: frozen pydantic models whose fields are their options."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from pydantic import BaseModel, ConfigDict
from typing_extensions import override

if TYPE_CHECKING:
    from crossgrad_core.contract.backbone import Backbone
    from crossgrad_core.contract.operator import Operator
    from crossgrad_core.contract.rasterizer import Rasterizer
    from crossgrad_core.contract.sampler import Sampler


class Component(BaseModel):
    """Base of everything that fills a slot.

    The fields are the options (typed, bounded, documented); running state is never kept here but
    passed in and returned as `PluginState`.

    Attributes:
        slot: The slot that the component fills; set by the slot's base class.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False
    )

    slot: ClassVar[str]

    def idle_options(self, selection: "Selection") -> Mapping[str, str]:
        """Options that would change nothing in this selection: name -> why, and the way out.

        A new run is refused where the user has set one of them to something else than its default.
        """
        return {}

    def set_for_nothing(self, selection: "Selection") -> dict[str, str]:
        """The idle options that were set to something else than their default."""
        fields = type(self).model_fields
        return {
            name: why
            for name, why in self.idle_options(selection).items()
            if name in self.model_fields_set and getattr(self, name) != fields[name].default
        }


@dataclass(frozen=True)
class ViewCounts:
    """For which numbers K of views per step something has a meaning.

    Attributes:
        minimum: Smallest K.
        maximum: Largest K; None for any.
        multiple_of: K must be a multiple of this.
    """

    minimum: int = 1
    maximum: int | None = None
    multiple_of: int = 1

    def admits(self, views: int) -> bool:
        """Whether K = `views` has a meaning."""
        above = self.maximum is not None and views > self.maximum
        return views >= self.minimum and not above and views % self.multiple_of == 0

    @override
    def __str__(self) -> str:
        if self.maximum == self.minimum:
            return f"K = {self.minimum}"
        parts = [f"K >= {self.minimum}"]
        if self.maximum is not None:
            parts = [f"{self.minimum} <= K <= {self.maximum}"]
        if self.multiple_of > 1:
            parts.append(f"K a multiple of {self.multiple_of}")
        return ", ".join(parts)


@dataclass(frozen=True)
class Selection:
    """The chosen components of a run, for objections.

    Attributes:
        components: Slot (singular word: `sampler`, `operator`, `backbone`, `densifier`,
            `rasterizer`, `grouping`, `reader`) -> component.
        names: The same slots -> name under which the component was chosen.
        views_per_step: K.
        device: Torch device type.
        labels: Labels that training views have by the grouping; None where it is not known yet, or
            where there is no grouping.
    """

    components: Mapping[str, Component]
    names: Mapping[str, str]
    views_per_step: int
    device: str
    labels: tuple[str, ...] | None = None

    @property
    def backbone(self) -> "Backbone":
        """The chosen backbone."""
        return cast("Backbone", self.components["backbone"])

    @property
    def sampler(self) -> "Sampler":
        """The chosen sampler."""
        return cast("Sampler", self.components["sampler"])

    @property
    def operator(self) -> "Operator":
        """The chosen operator."""
        return cast("Operator", self.components["operator"])

    @property
    def rasterizer(self) -> "Rasterizer":
        """The chosen rasterizer."""
        return cast("Rasterizer", self.components["rasterizer"])
