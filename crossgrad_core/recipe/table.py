"""The table of decided settings: a recipe makes the table, and a run applies and shows it."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.component import answered
from crossgrad_core.contract.decision import Decision
from crossgrad_core.contract.slots.recipe import Facts, Recipe
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.registry.slots import GROUPS
from crossgrad_core.registry.validation import as_user_error
from crossgrad_core.wording import listed, plural

#: Settings that every run needs and that have no default. A recipe decides each of these settings.
DECIDED: Final = (
    *(
        "views_per_step",
        "densifier",
        "initializer",
        "exposure",
        "resolution",
    ),
    *("schedule_unit", "growth", "max_gaussians", "min_refinements", "reset_every", "sh_start"),
    *("position_lr", "rate_factor", "few_pass_rates", "beta1", "beta2", "step_order"),
    *("eval_every", "save_every"),
)
#: First part of the names of settings for rules. The row `rules.NAME` contains the options of the
#: rule, or False if the rule is not used.
RULES: Final = "rules"
#: Maximum number of decision lines in the terminal.
LINES: Final = 12


def recipe_of(config: RunConfig) -> Recipe:
    """Return the recipe of a run."""
    return build(Recipe, config.recipe.name, config.recipe.options)


def is_given(config: RunConfig, setting: str) -> bool:
    """Return True if a setting, or an option of a component, already has a value."""
    name, _, option = setting.partition(".")
    value = getattr(config, name, None)
    if name == RULES:
        return option in config.rules if option else name in config.model_fields_set
    if option:
        return isinstance(value, ComponentChoice) and option in value.options
    if name not in config.model_fields_set or value is None:
        return False
    if isinstance(value, ComponentChoice):
        return value.name != AUTO or AUTO in entries(plural(name))
    return bool(value != AUTO)


def given_settings(config: RunConfig) -> dict[str, Any]:
    """Return the settings that already have a value, and always `max_gaussians`."""
    names = (name for name in config.model_fields_set if is_given(config, name))
    given = {name: getattr(config, name) for name in names}
    return given | {"max_gaussians": config.max_gaussians}


def is_complete(config: RunConfig) -> bool:
    """Return True if no recipe is needed, because the configuration contains all decisions."""
    return all(is_given(config, name) for name in (*DECIDED, RULES))


def decide(config: RunConfig, facts: Facts) -> tuple[Decision, ...]:
    """Return the recipe's decisions on the settings that have no value yet.

    Raises:
        UserError: The recipe does not decide a setting that a run needs.
    """
    recipe = recipe_of(config)
    rows = answered(recipe.decide(facts), list, recipe, "decide")
    table = {row.setting: row for row in rows if not is_given(config, row.setting)}
    missing = [name for name in DECIDED if name not in table and not is_given(config, name)]
    if missing:
        raise UserError(
            f"recipe {config.recipe.name} does not decide every setting that it must decide",
            where=f"{type(recipe).__module__}:{type(recipe).__qualname__}.decide",
            expected=f"a row for each of {listed(DECIDED)}",
            found=f"no row for {listed(missing)}",
            todo="repair the plugin, or set the value: "
            + listed(f"--set {n}=..." for n in missing),
        )
    return tuple(table.values())


def applied(config: RunConfig, rows: Sequence[Decision], planner: str = "") -> RunConfig:
    """Return the configuration with decided values and their reasons.

    Args:
        config: The configuration.
        rows: The decisions.
        planner: Name of the planner that made the rows; empty if the recipe made them.

    Raises:
        UserError: A row names a setting that does not exist, or gives a setting a wrong value.
    """
    update: dict[str, Any] = {RULES: {}, **config.model_dump(exclude_unset=True)}
    for row in sorted(rows, key=lambda row: "." in row.setting):
        name, _, option = row.setting.partition(".")
        held = update.get(name)
        if name == RULES:
            update[name] = {**update[name], option: row.value}
        elif option:
            update[name] = {**_settings_of(config, name), **(held or {}), option: row.value}
        elif isinstance(held, dict) and isinstance(row.value, str):
            update[name] = {**held, "name": row.value}
        else:
            update[name] = _long_form(name, row.value)
    update["decided"] = {**config.decided, **{row.setting: row.because for row in rows}}
    try:
        return RunConfig.model_validate(update)
    except ValidationError as error:
        subject = f"planner {planner}" if planner else f"recipe {config.recipe.name}"
        todo = "repair the plugin, or choose another --recipe (--plan off turns the planner off)"
        raise as_user_error(error, RunConfig, subject=subject, todo=todo) from error


def _settings_of(config: RunConfig, name: str) -> dict[str, Any]:
    """Return the present options of a component, or of a group of settings, as a mapping."""
    value = getattr(config, name, None)
    return value.model_dump(exclude_unset=True) if isinstance(value, BaseModel) else {"name": AUTO}


def _long_form(name: str, value: object) -> object:
    """Return the value of a setting; the name of a component becomes a mapping with this name."""
    component = plural(name) in GROUPS
    return {"name": value} if component and isinstance(value, str) else value


def open_again(config: RunConfig) -> RunConfig:
    """Return the configuration as the user set it, without decided values."""
    update: dict[str, Any] = config.model_dump(exclude_unset=True)
    without_decided(update)
    return RunConfig.model_validate(update)


def without_decided(settings: dict[str, Any]) -> None:
    """Remove decided values and the record `decided` from plain settings."""
    decided = settings.pop("decided", None) or {}
    for setting in decided:
        name, _, option = str(setting).partition(".")
        if not option:
            settings.pop(name, None)
        elif isinstance(settings.get(name), dict):
            settings[name] = {k: v for k, v in settings[name].items() if k != option}


def rows_of(config: RunConfig) -> tuple[Decision, ...]:
    """Return the decisions recorded in a configuration, without their evidence."""
    values = ((name, _value(config, name), why) for name, why in config.decided.items())
    # Leave out settings without a value. For example, a run with a time budget has converted its
    # limit on views to a number of steps.
    return tuple(Decision(*row) for row in values if row[1] is not None)


def _value(config: RunConfig, setting: str) -> object:
    name, _, option = setting.partition(".")
    value = getattr(config, name)
    if isinstance(value, ComponentChoice):
        return value.options.get(option) if option else value.name
    if name == RULES:
        return value.get(option)
    return getattr(value, option) if option else value


def short_lines(rows: Iterable[Decision]) -> tuple[str, ...]:
    """Return at most `LINES` lines, one for each decision that differs from the published value."""
    shown = [f"{_value_text(row)}: {row.because} ({row.override})" for row in rows if row.override]
    left = len(shown) - LINES
    if left > 0:
        shown = [*shown[: LINES - 1], f"{left + 1} more decisions (-v shows all)"]
    return tuple(shown)


def full_lines(rows: Iterable[Decision]) -> tuple[str, ...]:
    """Return one line for each decision, with its evidence."""
    explained = ((row, "; ".join(filter(None, (row.because, row.evidence)))) for row in rows)
    return tuple(
        f"{_value_text(row)}: {text}" + (f" ({row.override})" if row.override else "")
        for row, text in explained
    )


def table_lines(rows: Sequence[Decision]) -> tuple[str, ...]:
    """Return the lines of the table with the columns setting, value and reason."""
    names = max((len(row.setting) for row in rows), default=0)
    values = max((len(shown(row.value)) for row in rows), default=0)
    return tuple(
        f"{row.setting:<{names}}  {shown(row.value):<{values}}  {row.because}" for row in rows
    )


def _value_text(row: Decision) -> str:
    return f"{row.setting} {shown(row.value)}"


def shown(value: object) -> str:
    """Return the text of a value in a table."""
    match value:
        case dict():
            return ", ".join(f"{name} {shown(item)}" for name, item in value.items()) or "on"
        case bool():
            return str(value).lower()
        case float():
            return f"{value:.3g}"
        case int():
            return f"{value:,}"
    return str(value)
