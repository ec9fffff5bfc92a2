"""Gradient measurements during a run: conflict, ratios, variance within and between groups."""

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, PrivateAttr

from crossgrad_core.plugin import Model, Observer, RunInfo, hookimpl

if TYPE_CHECKING:
    from crossgrad_plugins.diagnostics.watch import Watch

#: Number of gradient measurements in a run if the user does not set an interval.
_PROBES = 8


class Diagnostics(Observer):
    """An observer that measures the gradients of chosen views at an interval.

    The observer writes diagnostics.csv, cameras.csv, groupings.csv and diagnostics.png to the run's
    folder. The observer draws views with its own generator, so it does not change the result of
    training. A measurement costs a forward and a backward pass of each chosen view. Its time does
    not count as training time, and is stored in the column `probe_seconds`.
    """

    every: int | None = Field(
        None, ge=1, description="steps between probes; default: an eighth of the run"
    )
    views: int = Field(
        12, ge=2, description="maximum number of probed training views of each group"
    )
    grouping: str | None = Field(
        None,
        description="grouping into near and far views; default: the run's grouping, else radial",
    )
    seed: int = Field(0, ge=0, description="seed for the choice of views and for the bootstrap")

    # The results so far. These values are not stored in checkpoints.
    _run: RunInfo | None = PrivateAttr(default=None)
    _watch: "Watch | None" = PrivateAttr(default=None)

    @hookimpl
    def crossgrad_run_start(self, run: RunInfo) -> None:
        """Keep the run and its output folder for later calls."""
        self._run, self._watch = run, None

    @hookimpl
    def crossgrad_model_ready(self, model: Model) -> None:
        """Measure the gradients if a measurement is due, and write the table."""
        if self._watch is None:
            self._watch = self._start(model)
        watch = self._watch
        rows_before = len(watch.rows)
        watch.crossgrad_model_ready(model)
        folder = self._folder()
        if folder is not None and len(watch.rows) > rows_before:
            from crossgrad_core.commands import write_table
            from crossgrad_plugins.diagnostics.report import PROBES

            write_table(folder / PROBES, watch.rows)

    @hookimpl
    def crossgrad_run_end(self, status: str) -> None:
        """Write the figure and the tables that do not change during the run."""
        folder, watch, run = self._folder(), self._watch, self._run
        if folder is None or watch is None or run is None or watch.last is None:
            return
        watch.report(run.scene, f"{folder.name}, {status}").write(folder)

    def _folder(self) -> Path | None:
        return None if self._run is None else self._run.folder

    def _start(self, model: Model) -> "Watch":
        """Choose the views to measure, and read the earlier rows of a resumed run."""
        from crossgrad_plugins.diagnostics.plan import (
            DEFAULT_GROUPING,
            OF_THE_RUN,
            labelled,
            plan_probe,
            require_views,
        )
        from crossgrad_plugins.diagnostics.report import PROBES, read_probes
        from crossgrad_plugins.diagnostics.watch import Watch

        require_views(model.scene)
        if self.grouping is None and model.groups is not None:
            name, labels = OF_THE_RUN, model.groups
        else:
            name = self.grouping or DEFAULT_GROUPING
            labels, _ = labelled(model.scene, name, self.seed)
        plan = plan_probe(model.scene, name, labels, self.views, self.seed)
        total = model.phase.schedule.total
        watch = Watch(plan, self.every or max(1, total // _PROBES), total, self.seed)
        folder = self._folder()
        if folder is not None:
            rows = read_probes(folder / PROBES)
            watch.rows += [row for row in rows if int(row["step"]) < model.phase.step]
        return watch
