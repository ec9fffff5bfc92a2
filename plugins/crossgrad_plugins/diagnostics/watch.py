"""Gradient measurements of a run at an interval."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import names
from crossgrad_core.plugin import (
    Model,
    Scene,
    UserError,
    bimodality,
    footprint_of,
    hookimpl,
    radial_distances,
)
from crossgrad_plugins.diagnostics.distances import relative_variance
from crossgrad_plugins.diagnostics.grouped import (
    SMALLEST_GROUP,
    Groups,
    gradient_ratio,
    variance_split,
)
from crossgrad_plugins.diagnostics.plan import ProbePlan, labelled, plan_probe
from crossgrad_plugins.diagnostics.probe import Measurement, measure
from crossgrad_plugins.diagnostics.report import Report
from crossgrad_plugins.diagnostics.table import Row, per_pair_conflict, table
from crossgrad_plugins.groupings.heights import altitudes, upward

#: Groupings that are evaluated with the gradients of the same measurement (prediction P4 of the
#: paper).
GROUPINGS = ("radial", "altitude", "footprint", "kmeans", "gmm")


def distances_of(scene: Scene) -> dict[str, NDArray[np.float64]]:
    """Return distances [N] of the training views, by name of the kind of distance.

    Distance `radial` is the distance from the mean camera, as in the paper. Distance `depth` is the
    median depth of the SfM points divided by the focal length, relative to the median view. It
    exists only if every view sees points.
    """
    views = scene.train_views
    distances = {"radial": radial_distances(scene, views)}
    footprints = np.array([footprint_of(scene, view) for view in views])
    if not np.isnan(footprints).any():
        distances["depth"] = np.median(footprints) / footprints
    return distances


def camera_rows(scene: Scene) -> list[Row]:
    """Return the bimodality of heights and log-distances, and the variance of distances."""
    axis, source = upward(scene)
    # Name -> values of a distance, and Var(r) / mean(r)^2 of the distance r. Heights have no
    # relative variance, because their origin is arbitrary.
    heights = altitudes(scene, scene.train_views, axis)
    samples = {f"height ({source})": (heights, float("nan"))}
    for name, values in distances_of(scene).items():
        logs = np.log(values[values > 0.0])
        samples[f"log {name} distance"] = logs, relative_variance(values)
    rows: list[Row] = []
    for name, (values, variance) in samples.items():
        coefficient = bimodality(values)
        rows.append(
            {
                "quantity": name,
                "views": coefficient.size,
                "bimodality_sample": coefficient.sample,
                "bimodality_population": coefficient.population,
                "relative_variance": variance,
                "note": coefficient.reason,
            }
        )
    return rows


def grouping_rows(scene: Scene, measurement: Measurement, seed: int) -> list[Row]:
    """Return the rows of one probe for several groupings.

    If a grouping cannot divide the scene, its row contains the reason.
    """
    rows: list[Row] = []
    for name, labels, reason in _groupings(scene, seed):
        if reason:
            rows.append({"grouping": name, "note": reason})
            continue
        plan = plan_probe(scene, name, labels, len(labels), seed)
        places = [
            position
            for position, view in enumerate(measurement.views)
            if labels[view] in {plan.near_label, plan.far_label}
        ]
        near = plan.near([measurement.views[position] for position in places])
        probed = min(int(near.sum()), int((~near).sum()))
        if probed < SMALLEST_GROUP:
            rows.append({"grouping": name, "note": "one of its groups has too few probed views"})
            continue
        rows += _read_by(plan.grouping, plan.cameras, _part(measurement, places), near)
    return rows


def _groupings(scene: Scene, seed: int) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Yield (name, labels, reason if there are no labels) of every grouping and of the regimes."""
    regimes = tuple(view.regime for view in scene.train_views)
    if len(set(regimes)) > 1:
        yield "regime", regimes, ""
    for name in GROUPINGS:
        if name not in names("groupings"):
            continue
        try:
            yield name, labelled(scene, name, seed)[0], ""
        except UserError as error:
            yield name, (), error.what


def _part(measurement: Measurement, places: list[int]) -> Measurement:
    """Reduce a measurement to some of its views."""
    square = np.ix_(range(len(measurement.blocks)), places, places)
    return Measurement(
        step=measurement.step,
        views=tuple(measurement.views[position] for position in places),
        blocks=measurement.blocks,
        kinds=measurement.kinds,
        plain=measurement.plain[square],
        adam=None if measurement.adam is None else measurement.adam[square],
        overlap=measurement.overlap[square],
        dropped=measurement.dropped,
        share=measurement.share,
    )


def _read_by(
    grouping: str, cameras: tuple[int, int], measurement: Measurement, near: NDArray[np.bool_]
) -> Iterator[Row]:
    per_pair = per_pair_conflict(measurement, near)
    for block, gramian in zip(measurement.blocks, measurement.plain, strict=True):
        figures: Mapping[str, float] = {
            "ratio_of_means": gradient_ratio(np.diag(gramian), near).of_means,
            "rho": variance_split(gramian, Groups(near)).ratio,
            "per_pair_conflict": per_pair,
        }
        yield {
            "grouping": grouping,
            "note": "",
            "near_cameras": cameras[0],
            "far_cameras": cameras[1],
            "near_probed": int(near.sum()),
            "far_probed": int((~near).sum()),
            "block": block,
            **figures,
        }


@dataclass
class Watch:
    """Measures the gradients of chosen views at an interval and at the end of a run.

    Attributes:
        plan: The measured views and their groups.
        every: Number of steps between two measurements.
        total: The last step of the run.
        seed: Seed of the measurements' own generator.
        rows: The rows of the table so far.
        last: The last measurement.
    """

    plan: ProbePlan
    every: int
    total: int
    seed: int
    rows: list[Row] = field(default_factory=list)
    last: Measurement | None = None

    def due(self, step: int) -> bool:
        """Return True if a measurement is due after this step."""
        # Skip a measurement shortly before the end of the run, because another one follows at the
        # end.
        return step == self.total or (step % self.every == 0 and step <= self.total - self.every)

    @hookimpl
    def crossgrad_model_ready(self, model: Model) -> None:
        """Measure the gradients if a measurement is due."""
        if not self.due(model.phase.step):
            return
        start = perf_counter()
        self.last = measure(model, self.plan.views, np.random.default_rng(self.seed))
        rows = table(self.last, self.plan, distances_of(model.scene), self.seed)
        seconds = round(perf_counter() - start, 3)
        self.rows += [{**row, "probe_seconds": seconds} for row in rows]

    def report(self, scene: Scene, which: str) -> Report:
        """Return the complete report.

        Args:
            scene: The scene.
            which: Description of the measured model.

        Raises:
            UserError: No gradients were measured.
        """
        if self.last is None:
            raise UserError(
                "the model was never probed, because training was too short",
                where=scene.name,
                todo="train for more steps",
            )
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
        yield f"left out, because their gradient is not finite: {', '.join(measurement.dropped)}"
    if measurement.share < 1.0:
        yield f"gradients of a random {measurement.share:.0%} of the Gaussians"
