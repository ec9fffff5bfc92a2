"""Select the runs that a grid requests, because a sweep's folder may also contain older runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from crossgrad_core.commands import RunConfig, UserError, configured
from crossgrad_core.contract.schedule import ViewsPerStepSpec
from crossgrad_plugins.compare.load_runs import without_length
from crossgrad_plugins.compare.run import ABSENT, Run, Settings, settings_of
from crossgrad_plugins.sweep.best import LENGTHS
from crossgrad_plugins.sweep.grid import Choice, Grid
from crossgrad_plugins.sweep.job import Layout
from crossgrad_plugins.sweep.summary import earlier_rows

#: Values that mean that a run decides a setting at its start.
_LEFT_OPEN: Final = ("auto", ABSENT)
#: Settings that are not compared: paths, which may be relative to the folder of the grid, and
#: `plan`, which a run changes.
_OTHERWISE: Final = ("exposure_from", "data.init", "plan")


@dataclass(frozen=True)
class Asked:
    """The settings that a grid gives to an arm on a scene.

    Settings that the grid does not give may have any value.

    Attributes:
        config: The configuration.
        settings: The given settings that can define an arm.
        has_length: True if the grid gives a length.
    """

    config: RunConfig
    settings: Settings
    has_length: bool

    @classmethod
    def of(
        cls, grid: Grid, choice: Choice, scene: str | None, assignments: Sequence[str] = ()
    ) -> "Asked":
        """Return the settings that the grid gives; the scene is not read.

        Args:
            grid: The grid.
            choice: A configuration of the grid.
            scene: A scene of the grid.
            assignments: Texts `KEY=VALUE` that override the grid.

        Raises:
            UserError: A setting does not exist or has a wrong value.
        """
        settings = choice.settings(grid.base, scene, assignments)
        config = configured(settings)
        named = settings_of(config.model_dump(mode="json", exclude_unset=True))
        return cls(config, named, bool(LENGTHS & settings.keys()))

    def fits(self, run: Run) -> bool:
        """Return True if a run uses all given settings.

        A setting that is not decided yet, or is unknown, counts as equal.
        """
        return (not self.has_length or self._fits_length(run)) and all(
            asked in {run.settings.get(name, asked), *_LEFT_OPEN}
            for name, asked in self.settings.items()
            if name not in _OTHERWISE
        )

    def _fits_length(self, run: Run) -> bool:
        asked, found = self.config, run.config
        if asked.seconds is not None:
            bound = found.get("planned_views") or found.get("max_views")
            length = ("s CPU" if asked.clock == "cpu" else "s", asked.seconds)
            return (run.length, bound) == (length, asked.max_views)
        if asked.max_views is None:
            return found.get("steps") == asked.steps
        # A run stores a length in views as a number of steps.
        views = ViewsPerStepSpec.parsed(str(found.get("views_per_step") or 1))
        return asked.max_views == found.get("max_views") or (
            views.steps_of(asked.max_views) == found.get("steps")
        )


def of_earlier_grids(runs: Sequence[Run]) -> frozenset[Run]:
    """Return the runs that belong to earlier grids, according to the table of their sweep.

    Raises:
        UserError: A table cannot be read.
    """
    tables = {
        sweep: {(name, without_length(label)) for name, label in earlier_rows(Layout(sweep))}
        for sweep in {run.results.folder.parent.parent for run in runs}
    }
    return frozenset(
        run
        for run in runs
        if (run.results.folder.name, run.label) in tables[run.results.folder.parent.parent]
    )


def asked_for(runs: Sequence[Run], asked: Asked, earlier: frozenset[Run]) -> list[Run]:
    """Return the runs that the grid requests, from runs with the same label, scene and seed.

    Args:
        runs: The runs.
        asked: The settings that the grid gives.
        earlier: Runs of earlier grids, according to the table of their sweep. If all runs belong to
            earlier grids, no run is returned, because the run of the present grid has not ended. If
            the run of the present grid exists but does not fit, the table belongs to another grid
            and is ignored.
    """
    fitting = [run for run in runs if asked.fits(run)]
    current = [run for run in fitting if run not in earlier]
    is_of_another_grid = any(run not in earlier for run in runs)
    return current or (fitting if is_of_another_grid else [])


def only(runs: Sequence[Run], label: str) -> Run:
    """Return the first of several runs with the same label, scene and seed.

    These runs must be repetitions of one run.

    Raises:
        UserError: The runs have different configurations.
    """
    first, *others = runs
    for other in others:
        if difference := _difference(first, other):
            raise UserError(
                f"{label or 'an arm'} has two configurations with seed {first.seed}"
                f" on {first.scene}",
                where=f"{first.results.folder}, {other.results.folder}",
                expected="one configuration; the folder may contain runs of an earlier grid",
                found=difference,
                todo="move the folder of the unwanted run away",
            )
    return first


def _difference(first: Run, second: Run) -> str:
    """Return the differences of settings that both runs have; empty without differences."""
    found = [
        f"{name} {value} against {second.settings[name]}"
        for name, value in first.settings.items()
        if second.settings.get(name, value) != value
    ]
    lengths = [run.length_text for run in (first, second)]
    return ", ".join([*found, *([" against ".join(lengths)] if len(set(lengths)) > 1 else [])])
