"""The grid file: settings, scenes and seeds of a sweep."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from math import prod
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    ValidationError,
    field_validator,
    model_validator,
)

from crossgrad_core.commands import UserError, did_you_mean, layered, listed, read_settings
from crossgrad_plugins.sweep.problems import Problem, refuse

Settings: TypeAlias = dict[str, Any]
T = TypeVar("T")

_TODO = "docs/sweep.md shows the format"
#: Maximum number of runs of a sweep. All runs are planned before the first run starts, and a short
#: grid file can describe millions of runs.
MOST_RUNS = 100_000
#: Settings that the sweep itself sets -> explanation for the user.
_RESERVED = {
    "out": "every run has its own folder below --out",
    "stop_after": "a sweep runs every run to its end",
    "threads": "use --threads, which applies to all runs",
}
#: Settings for which the sweep has a separate option.
_OPTIONS = {"scene": "--scene SCENE", "seed": "--seed N"}
_SHAPE = "must be `values: [...]`, `value: ...` or `parameters: {...}`"
#: Error type of pydantic -> message for readers of a YAML file.
_IN_YAML = {"tuple_type": "should be a list", "too_short": "should not be empty"}
_WITH_DISTRIBUTION = frozenset({"min", "max", "distribution", "mu", "sigma", "q", "probabilities"})


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Parameter(_Part):
    """A setting of the grid, with one or several values.

    Attributes:
        values: The values, if the setting varies.
        value: The value, if the setting does not vary.
        parameters: Settings inside this setting, such as options of a component.
    """

    values: tuple[Any, ...] | None = Field(None, min_length=1)
    value: Any = None
    parameters: "dict[str, Parameter] | None" = None

    @model_validator(mode="before")
    @classmethod
    def _is_a_list(cls, given: object) -> object:
        if not isinstance(given, Mapping):
            raise ValueError(_SHAPE)  # noqa: TRY004 - pydantic reports ValueError
        if drawn := sorted(_WITH_DISTRIBUTION & given.keys()):
            raise ValueError(f"distributions ({listed(drawn)}) are not supported: list values")
        if len({"values", "value", "parameters"} & given.keys()) != 1:
            raise ValueError("must have exactly one of `values`, `value` and `parameters`")
        return given

    def axes(self, name: str) -> Iterator[tuple[str, tuple[Any, ...]]]:
        """Yield each varied setting with its values; nested settings have names with dots."""
        if self.parameters is not None:
            for inner, parameter in self.parameters.items():
                yield from parameter.axes(f"{name}.{inner}")
        else:
            yield name, (self.value,) if self.values is None else self.values


class Arm(_Part):
    """A named configuration of the grid.

    Attributes:
        name: Name of the configuration.
        settings: The settings of the configuration.
        parameters: Settings that vary in this arm only.
        by_scene: Name of a scene's folder -> settings for this scene only.
    """

    name: str = Field(min_length=1)
    settings: Settings = Field(default_factory=dict)
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    by_scene: dict[str, Settings] = Field(default_factory=dict)


class Metric(_Part):
    """The metric of the final table.

    Attributes:
        name: A metric of the held-out views, as in summary.json.
        goal: `maximize` or `minimize`; by default `minimize` for LPIPS, else `maximize`.
    """

    name: str = "psnr"
    goal: Literal["maximize", "minimize"] = "maximize"

    @model_validator(mode="before")
    @classmethod
    def _default_goal(cls, given: object) -> object:
        if isinstance(given, Mapping) and str(given.get("name")).startswith("lpips"):
            return {"goal": "minimize", **given}
        return given


class Grid(_Part):
    """The contents of a grid file.

    Attributes:
        name: Name of the sweep; by default the name of the grid file.
        description: The purpose of the grid.
        method: The value `grid` runs every combination.
        base: Settings of all runs, as in a configuration file.
        scenes: Scene folders; None stands for the bundled scene.
        seeds: Seeds of the runs.
        arms: Named configurations; by default there is one.
        parameters: Settings that vary in all arms.
        metric: The metric of the final table.
    """

    name: str | None = None
    description: str = ""
    method: Literal["grid"] = "grid"
    base: Settings = Field(default_factory=dict)
    scenes: tuple[str | None, ...] = Field((None,), min_length=1)
    seeds: tuple[NonNegativeInt, ...] = Field((0,), min_length=1)
    arms: tuple[Arm, ...] = Field((Arm(name="run"),), min_length=1)
    parameters: dict[str, Parameter] = Field(default_factory=dict)
    metric: Metric = Metric()

    @field_validator("name")
    @classmethod
    def _is_a_folder(cls, name: str | None) -> str | None:
        if name is not None and (name in {"", ".", ".."} or set(name) & {"/", "\\", "\0"}):
            raise ValueError("must be the name of a folder below runs/sweeps, without slashes")
        return name

    @model_validator(mode="before")
    @classmethod
    def _axes_with_names(cls, given: object) -> object:
        """Move scenes and seeds out of the parameters.

        Other formats of grids list them there.
        """
        if not isinstance(given, dict) or not isinstance(given.get("parameters"), dict):
            return given
        moved = {"scene": "scenes", "seed": "seeds"}
        parameters = dict(given["parameters"])
        axes = {new: parameters.pop(old) for old, new in moved.items() if old in parameters}
        if twice := sorted(axes.keys() & given.keys()):
            raise ValueError(
                f"{listed(twice)} may be given only once, at the top level or among the parameters"
            )
        return {**given, **{n: _values(p) for n, p in axes.items()}, "parameters": parameters}


def check_assignments(assignments: Iterable[str]) -> None:
    """Refuse settings that cannot be set for all runs of a sweep with `--set`.

    Raises:
        UserError: The sweep itself sets a setting, or has a separate option for it.
    """
    for name in (assignment.partition("=")[0].strip() for assignment in assignments):
        instead = f"say {_OPTIONS[name]}" if name in _OPTIONS else _RESERVED.get(name)
        if instead is not None:
            raise UserError(f"{name} cannot be set with --set", where=f"--set {name}", todo=instead)


class Choice(_Part):
    """One configuration of a grid: an arm with values for the varied settings.

    Attributes:
        arm: The arm of the grid.
        parameters: Setting -> value, for the varied settings.
    """

    arm: Arm
    parameters: Settings

    @property
    def label(self) -> str:
        """The name of the configuration in tables."""
        values = [f"{name}={value}" for name, value in self.parameters.items()]
        return ", ".join([self.arm.name, *values])

    def settings(
        self, base: Settings, scene: str | None, assignments: Sequence[str] = ()
    ) -> Settings:
        """Return the settings of runs of this configuration on a scene, without the seed.

        Args:
            base: The settings of all runs of the grid.
            scene: The scene's folder; None stands for the bundled scene.
            assignments: Texts `KEY=VALUE` that override the grid.

        Raises:
            UserError: An assignment, or a key with a dot, is invalid.
        """
        scene_settings = self.arm.by_scene.get(scene_name(scene), {})
        layers = (base, self.arm.settings, self.parameters, scene_settings)
        return {**layered(layers, assignments), **({} if scene is None else {"scene": scene})}


def _values(parameter: object) -> object:
    """Return the values of a parameter that is not a setting of runs, such as scene or seed."""
    if isinstance(parameter, Mapping):
        return parameter.get("values", [parameter.get("value")])
    return parameter


def choices(grid: Grid) -> list[Choice]:
    """Return all configurations, arm by arm; the values of the last parameter change fastest."""
    configurations = []
    for arm in grid.arms:
        axes = _axes(grid, arm)
        configurations += [
            Choice(arm=arm, parameters=dict(zip(axes, values, strict=True)))
            for values in product(*axes.values())
        ]
    return configurations


def _axes(grid: Grid, arm: Arm) -> dict[str, tuple[Any, ...]]:
    """Return the values of the settings that vary in an arm: setting -> values."""
    parameters = {**grid.parameters, **arm.parameters}
    return dict(axis for name, parameter in parameters.items() for axis in parameter.axes(name))


def read_grid(path: Path) -> Grid:
    """Read the grid in a YAML file.

    Raises:
        UserError: The file cannot be read, or the grid is invalid; the message lists all problems.
    """
    content = read_settings(path, "the grid", _TODO)
    try:
        grid = Grid.model_validate(content)
    except ValidationError as error:
        refuse([_problem(detail) for detail in _own(error.errors(include_url=False))], path)
        raise
    here = path.resolve().parent
    scenes = tuple(scene and _absolute(scene, here) for scene in grid.scenes)
    grid = grid.model_copy(update={"scenes": scenes})
    refuse(list(_of_the_settings(grid)), path)
    return grid


def _absolute(scene: str, here: Path) -> str:
    return str((here / Path(scene).expanduser()).resolve())


def _own(errors: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Remove errors about too few items if another error explains the missing item."""
    return [
        error
        for error in errors
        if error["type"] != "too_short"
        or not any(o["loc"][: len(error["loc"])] == error["loc"] for o in errors if o is not error)
    ]


def _problem(error: Mapping[str, Any]) -> Problem:
    """Convert an error of pydantic to a problem with its position in the file."""
    path = [part for part in error["loc"] if part != "dict"]
    place = ".".join(str(part) for part in path) or "the grid"
    if error["type"] == "extra_forbidden":
        hint = did_you_mean(str(path[-1]), Grid.model_fields if len(path) == 1 else ())
        below = "base" if len(path) == 1 else "settings"
        return Problem(place, f"is not a key of a grid; put settings below {below}", hint)
    message = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
    message = _IN_YAML.get(error["type"], message)
    rejected = "" if error["type"] in {"missing", "value_error"} else f", not {error['input']!r}"
    return Problem(place, f"{message}{rejected}")


def _of_the_settings(grid: Grid) -> Iterator[Problem]:
    layers: list[tuple[str, Mapping[str, object]]] = [("base", grid.base)]
    layers.append(("parameters", grid.parameters))
    for arm in grid.arms:
        layers += [(f"arms.{arm.name}", arm.settings), (f"arms.{arm.name}", arm.parameters)]
        layers += [(f"arms.{arm.name}.by_scene.{name}", s) for name, s in arm.by_scene.items()]
    for place, settings in layers:
        for name, why in _RESERVED.items():
            if name in settings:
                yield Problem(f"{place}.{name}", f"cannot be set by a grid: {why}")
        for name, axis in (("scene", "scenes"), ("seed", "seeds")):
            if name in settings:
                yield Problem(f"{place}.{name}", f"cannot be set by a grid: list it in {axis}")
    yield from _of_the_names(grid)
    yield from _of_the_configurations(grid)


def _of_the_configurations(grid: Grid) -> Iterator[Problem]:
    if (runs := _number_of_runs(grid)) > MOST_RUNS:
        yield Problem("the grid", f"has {runs:.3g} runs; at most {MOST_RUNS:,} are allowed")
        return
    if _twice(arm.name for arm in grid.arms):
        return
    for label in _twice(choice.label for choice in choices(grid)):
        hint = "tables identify configurations by their names"
        yield Problem("arms", f"two configurations have the name {label!r}", hint)


def _of_the_names(grid: Grid) -> Iterator[Problem]:
    for name in _twice(arm.name for arm in grid.arms):
        yield Problem("arms", f"two entries have the name {name!r}")
    for seed in _twice(grid.seeds):
        yield Problem("seeds", f"{seed} is listed twice")
    scenes = [scene_name(scene) for scene in grid.scenes]
    for name in _twice(scenes):
        yield Problem("scenes", f"two entries have the name {name!r}")
    for arm in grid.arms:
        for name in arm.by_scene.keys() - set(scenes):
            hint = did_you_mean(name, scenes)
            yield Problem(f"arms.{arm.name}.by_scene", f"no scene has the name {name!r}", hint)


def _twice(values: Iterable[T]) -> list[T]:
    """Return the values that occur several times, in order."""
    return [value for value, number in Counter(values).items() if number > 1]


def _number_of_runs(grid: Grid) -> int:
    configurations = sum(prod(map(len, _axes(grid, arm).values())) for arm in grid.arms)
    return len(grid.scenes) * len(grid.seeds) * configurations


def scene_name(scene: str | None) -> str:
    """Return the name of a scene: the name of its folder."""
    return "the bundled scene" if scene is None else Path(scene).name


def with_scenes(grid: Grid, scenes: Sequence[Path]) -> Grid:
    """Return the grid with other scenes.

    Settings by scene are kept for scenes with equal names.

    Raises:
        UserError: Two scenes have the same name.
    """
    names = [path.resolve().name for path in scenes]
    if len(set(names)) < len(names):
        raise UserError(
            "two scenes have the same name",
            where="--scene",
            found=listed(names),
            todo="give one of the folders another name",
        )
    arms = tuple(
        arm.model_copy(
            update={"by_scene": {name: s for name, s in arm.by_scene.items() if name in names}}
        )
        for arm in grid.arms
    )
    folders = tuple(str(path.resolve()) for path in scenes)
    return grid.model_copy(update={"scenes": folders, "arms": arms})
