"""The plan of a sweep: all runs of a grid, checked but not trained."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crossgrad_core.commands import (
    UserError,
    assemble_new,
    build,
    chosen,
    configured,
    fingerprint,
    read_scene,
    resolved,
)
from crossgrad_plugins.sweep.grid import Choice, Grid, Settings, choices, scene_name
from crossgrad_plugins.sweep.job import Job, run_id
from crossgrad_plugins.sweep.problems import Problem, refuse

if TYPE_CHECKING:
    from crossgrad_core.commands import RunConfig

#: Maximum number of configurations that the message about a problem names.
MOST_PLACES = 3


@dataclass(frozen=True)
class Plan:
    """The runs of a grid.

    Attributes:
        grid: The grid.
        cells: All combinations, in the order of their runs; several combinations can be one run.
    """

    grid: Grid
    cells: tuple[Job, ...]

    @property
    def jobs(self) -> tuple[Job, ...]:
        """The runs of the plan; each run is listed once."""
        by_id: dict[str, Job] = {}
        for job in self.cells:
            by_id.setdefault(job.id, job)
        return tuple(by_id.values())


def planned(grid: Grid, path: Path, assignments: Sequence[str] = ()) -> Plan:
    """Plan the runs of a grid.

    The seed changes last, so that an interrupted sweep has runs of every configuration for the
    first seeds.

    Args:
        grid: The grid.
        path: The grid file; paths in settings are relative to its folder.
        assignments: Texts `KEY=VALUE` that override the grid.

    Raises:
        GridError: Settings, components or scenes are invalid; the error lists all problems.
    """
    planner = _Planner(grid.base, tuple(assignments))
    pairs = list(product(grid.scenes, choices(grid)))
    with chdir(path.resolve().parent):
        checked = [planner.checked(scene, choice) for scene, choice in pairs]
    refuse(planner.problems(), path)
    cells = [
        _job(scene, choice, seed, configuration)
        for seed in grid.seeds
        for (scene, choice), configuration in zip(pairs, checked, strict=True)
        if configuration is not None
    ]
    return Plan(grid, tuple(cells))


@dataclass(frozen=True)
class _Checked:
    """A configuration on a scene: its settings, all its options, and the scene's digest."""

    settings: Mapping[str, Any]
    resolved: Mapping[str, Any]
    fingerprint: str


@dataclass
class _Planner:
    """Checks configurations and collects problems; each problem is stored once."""

    base: Settings
    assignments: tuple[str, ...]
    _wrong: dict[str, list[str]] = field(default_factory=dict)
    _scenes: dict[str, Any] = field(default_factory=dict)

    def problems(self) -> list[Problem]:
        """Return the problems, and the configurations that have each problem."""
        return [Problem(_shortened(places), text) for text, places in self._wrong.items()]

    def checked(self, scene: str | None, choice: Choice) -> _Checked | None:
        """Check a configuration on a scene; return None if there is a problem."""
        label = choice.label
        try:
            settings = choice.settings(self.base, scene, self.assignments)
            config = configured(settings)
        except UserError as error:
            self._note(label, error)
            return None
        faults = list(_faults(config))
        for fault in faults:
            self._note(label, fault)
        scene_parts = self._scene(config)
        if faults or scene_parts is None:
            return None
        try:
            setup = assemble_new(config, scene_parts[0], scene_parts[1])
        except UserError as error:
            self._note(f"{scene_name(scene)}, {label}", error)
            return None
        final = {**resolved(setup), "seconds": config.seconds}
        return _Checked(settings, final, scene_parts[2])

    def _scene(self, config: "RunConfig") -> Any:  # noqa: ANN401 - a scene, its reader, its digest
        """Read the scene with the configured options; return None if it cannot be read."""
        key = f"{config.scene} {config.reader} {config.data}"
        if key not in self._scenes:
            try:
                scene, reader = read_scene(config)
                self._scenes[key] = (scene, reader, fingerprint(scene, config))
            except UserError as error:
                self._note(str(config.scene), error)
                self._scenes[key] = None
        return self._scenes[key]

    def _note(self, place: str, error: UserError) -> None:
        places = self._wrong.setdefault(str(error), [])
        if place not in places:
            places.append(place)


def _shortened(places: Sequence[str]) -> str:
    """Return the first configurations, and the number of those left out."""
    more = len(places) - MOST_PLACES
    return "; ".join([*places[:MOST_PLACES], *([f"and {more} more"] if more > 0 else [])])


def _faults(config: "RunConfig") -> Iterator[UserError]:
    """Yield the errors that components report about the configuration."""
    for slot, choice in chosen(config):
        try:
            build(slot, choice.name, choice.options)
        except UserError as error:
            yield error


def _job(scene: str | None, choice: Choice, seed: int, configuration: _Checked) -> Job:
    return Job(
        id=run_id({**configuration.resolved, "seed": seed}, configuration.fingerprint),
        label=choice.label,
        scene=scene_name(scene),
        seed=seed,
        settings={**configuration.settings, "seed": seed},
        seconds=configuration.resolved["seconds"],
    )
