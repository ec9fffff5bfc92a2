"""Probing a run at an interval."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from crossgrad_core.plugin import Model, Scene, UserError, hookimpl
from crossgrad_plugins.diagnostics.cameras import camera_rows, distances_of, grouping_rows
from crossgrad_plugins.diagnostics.plan import ProbePlan
from crossgrad_plugins.diagnostics.probe import Measurement, measure
from crossgrad_plugins.diagnostics.report import Report
from crossgrad_plugins.diagnostics.table import Row, table


@dataclass
class Watch:
    """Probes the model every so many steps, and at the end; all probes look at the same views.

    Attributes:
        plan: The views and their groups.
        every: Steps between probes.
        total: The last step of the run.
        seed: Seed of the probes' own generator.
        rows: The table so far.
        last: The last measurement.
    """

    plan: ProbePlan
    every: int
    total: int
    seed: int
    rows: list[Row] = field(default_factory=list)
    last: Measurement | None = None

    def due(self, step: int) -> bool:
        """Whether a probe belongs after this step."""
        # The probe at the end replaces the one shortly before it.
        return step == self.total or (step % self.every == 0 and step <= self.total - self.every)

    @hookimpl
    def crossgrad_model_ready(self, model: Model) -> None:
        """Probes where it is time."""
        if not self.due(model.phase.step):
            return
        start = perf_counter()
        self.last = measure(model, self.plan.views, np.random.default_rng(self.seed))
        found = table(self.last, self.plan, distances_of(model.scene), self.seed)
        seconds = round(perf_counter() - start, 3)
        self.rows += [{**row, "probe_seconds": seconds} for row in found]

    def report(self, scene: Scene, which: str) -> Report:
        """Everything that was found out.

        Args:
            scene: The scene.
            which: The model that was probed, in words.

        Raises:
            UserError: There was no probe.
        """
        if self.last is None:
            raise UserError("the model was never probed", where=scene.name, todo="train longer")
        return Report(
            scene=scene.name,
            title=f"{scene.name}: {which}",
            probes=self.rows,
            cameras=camera_rows(scene),
            groupings=grouping_rows(scene, self.last, self.seed),
            notes=(f"model: {which}", *self.plan.notes, *_shortcomings(self.last)),
        )


def _shortcomings(measurement: Measurement) -> Iterator[str]:
    if measurement.dropped:
        yield f"left out, gradient not finite: {', '.join(measurement.dropped)}"
    if measurement.share < 1.0:
        yield f"gradients of a random {measurement.share:.0%} of the primitives"
