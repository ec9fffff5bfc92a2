"""The settings that training uses, as plain numbers and choices after all decisions."""

from dataclasses import dataclass, fields
from typing import Literal

from crossgrad_core.config import Growth, RunConfig
from crossgrad_core.contract.schedule import Unit
from crossgrad_core.errors import UserError
from crossgrad_core.wording import listed


@dataclass(frozen=True)
class Numbers:
    """The settings of a run that a recipe can decide. `RunConfig` describes each setting."""

    rate_factor: float
    few_pass_rates: bool
    beta1: float
    beta2: float
    position_lr: Literal["extent", "per-axis"]
    growth: Growth
    max_gaussians: int | Literal["auto"]
    step_order: Literal["optimize-first", "densify-first"]
    schedule_unit: Unit
    min_refinements: int
    reset_every: int
    sh_start: float
    eval_every: int
    save_every: int

    @classmethod
    def of(cls, config: RunConfig) -> "Numbers":
        """Return the settings of a configuration.

        Raises:
            UserError: A setting has no value, because neither the user nor a recipe set a value.
        """
        values = {field.name: getattr(config, field.name) for field in fields(cls)}
        if missing := [name for name, value in values.items() if value is None]:
            raise UserError(
                "some settings that the run needs have no value",
                where=listed(missing),
                expected="a value from the user or from the recipe",
                todo="set them, or choose a --recipe that sets them",
            )
        return cls(**values)
