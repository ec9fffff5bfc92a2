"""The decision how often far and near views are drawn, from their viewing directions."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from crossgrad_core.commands import ComponentChoice, facts_of
from crossgrad_core.plugin import REFERENCE, Grouping, Json, Scene, build_component
from crossgrad_plugins.groupings.split import FAR
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import Finding, given
from crossgrad_plugins.planner.grouping import EVEN, pairs, settings_of
from crossgrad_plugins.planner.length import most_views

#: Number of far views per near view in the first stage of a run. The sampler `horizon` implements
#: this stage.
FAR_TO_NEAR: Final = 5
#: Maximum median angle of far views and minimum median angle of near views to the mean direction of
#: the far views, in degrees.
WITHIN, BEYOND = 45.0, 60.0


@dataclass(frozen=True)
class Directions:
    """Median angles between viewing directions and the mean direction of the far views.

    Attributes:
        far: Median angle of the far views, degrees.
        near: Median angle of the near views, degrees.
    """

    far: float
    near: float

    @property
    def differ(self) -> bool:
        """True if far views agree in their direction and near views look elsewhere."""
        return self.far <= WITHIN and self.near >= BEYOND


def directions(scene: Scene, grouping: ComponentChoice) -> Directions:
    """Measure the viewing directions of the far and near training views of a grouping."""
    made = build_component(Grouping, grouping.name, grouping.options)
    labels = made.fit(scene, np.random.default_rng(0)).labels(scene.train_views)
    far = np.array([label == FAR for label in labels])
    axes = np.stack([view.camera.world_to_camera[2, :3].numpy() for view in scene.train_views])
    mean = axes[far].mean(axis=0)
    cosines = axes @ (mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny))
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return Directions(float(np.median(angles[far])), float(np.median(angles[~far])))


def view_schedule(evidence: Evidence) -> Finding:
    """Decide if far views are drawn more often than near views in the first stage."""
    part, configured = "view schedule", evidence.config.sampler.name
    if evidence.is_given("sampler", "grouping"):
        return given(part, configured, "--sampler NAME")
    rule = (
        f"draw far : near = {FAR_TO_NEAR} : 1 at first if far views look in one "
        f"direction (median within {WITHIN:.0f} degrees) and near views elsewhere "
        f"({BEYOND:.0f} degrees or more), as with drone and street photos, and if "
        f"each side has at least {EVEN:.0%} of the views; in runs with a time limit "
        f"or with fewer than {REFERENCE:,} views"
    )
    source = "Horizon-GS, 2 : 1; docs/samplers.md#far-views-first"
    plain = Finding(part, configured, "default", "", rule, source, "--sampler horizon")
    if not evidence.is_measured or evidence.is_given("operator", "views_per_step"):
        return plain.found("measured only with recipe auto and single views")
    if not _in_short_run(evidence):
        return plain.found("measured only in shorter runs")
    if not evidence.modes.two:
        return plain.found("no two modes", decided=evidence.modes.one)
    return _schedule_of_two_modes(evidence, plain)


def _schedule_of_two_modes(evidence: Evidence, plain: Finding) -> Finding:
    """Decide by the viewing directions if far views are drawn more often."""
    if "sampler" in pairs(evidence).settings:
        return plain.found("a step has a near and a far view", decided=True)
    cut = evidence.modes.cut
    if cut.share < EVEN:
        return plain.found(f"the smaller mode has {cut.share:.0%} of the views")
    angles = directions(evidence.scene, cut.grouping)
    figures = {"far_degrees": angles.far, "near_degrees": angles.near}
    shown = (
        "relative to the mean direction of the far views, far views look "
        f"{angles.far:.0f} degrees away, near views {angles.near:.0f} (medians)"
    )
    made = plain.found(shown, decided=True, figures=figures)
    if not angles.differ:
        return made
    sampler: dict[str, Json] = {"sampler": "horizon", "sampler.coarse": [FAR_TO_NEAR, 1]}
    choice = f"horizon by {cut.grouping.name}, {FAR_TO_NEAR} far views for each near view at first"
    return made.changed(
        choice,
        {**sampler, **settings_of(cut.grouping)},
        "far views look in one direction, near views in others",
        f"--sampler {plain.choice}",
    )


def _in_short_run(evidence: Evidence) -> bool:
    """Return True if the run is short; the planned length is used."""
    config = evidence.config
    if config.steps is config.seconds is config.max_views is None:
        config = config.model_copy(update={"max_views": most_views(evidence)})
    return facts_of(config, evidence.scene).short
