"""Components: frozen pydantic models whose fields are their options."""

from dataclasses import dataclass
from typing import ClassVar

from pydantic import BaseModel, ConfigDict
from typing_extensions import override


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
