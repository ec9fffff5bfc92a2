"""Contract checks for recipes."""

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.slots.recipe import Facts, Recipe
from crossgrad_core.recipe.table import DECIDED
from crossgrad_core.run.decisions import facts_of
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    global_randomness_untouched,
    require,
)
from crossgrad_core.wording import listed


def decides_every_setting(make: Make[Recipe]) -> None:
    """Each setting without a default has exactly one row, in short runs and in long runs."""
    for steps in (30, 3_000, 60_000):
        names = [row.setting for row in make().decide(_facts(steps))]
        missing = [name for name in DECIDED if name not in names]
        require(not missing, f"no row for {listed(missing)} in a run of {steps} steps")
        twice = sorted({name for name in names if names.count(name) > 1})
        require(not twice, f"more than one row for {listed(twice)} in a run of {steps} steps")


def gives_a_reason_in_one_line(make: Make[Recipe]) -> None:
    """Each row contains a reason, and no text of a row has more than one line."""
    for row in make().decide(_facts(3_000)):
        require(isinstance(row, Decision), f"a row is {type(row).__name__}, not a Decision")
        require(row.because, f"the row of {row.setting} contains no reason")
        texts = (row.setting, row.because, row.evidence, row.override)
        require("\n" not in "".join(texts), f"a text of {row.setting} has more than one line")


def names_settings_that_exist(make: Make[Recipe]) -> None:
    """Each row names an existing setting of a run, or an option of a component."""
    settings = [*(row.setting for row in make().decide(_facts(3_000))), *make().settings]
    names = {setting.partition(".")[0] for setting in settings}
    unknown = sorted(names - RunConfig.model_fields.keys())
    require(not unknown, f"unknown settings: {listed(unknown)}")


def decides_the_same_again(make: Make[Recipe]) -> None:
    """Equal facts give equal rows in equal order."""
    with global_randomness_untouched():
        first, second = (make().decide(_facts(3_000)) for _ in range(2))
    require(first == second, "two calls return different rows")


def _facts(steps: int) -> Facts:
    """Return the properties of a run of `steps` steps on the sample scene."""
    return facts_of(RunConfig(steps=steps, device="cpu"), sample_scene())


RECIPE_CHECKS: tuple[Check[Recipe], ...] = (
    *COMPONENT_CHECKS,
    decides_every_setting,
    gives_a_reason_in_one_line,
    names_settings_that_exist,
    decides_the_same_again,
)
