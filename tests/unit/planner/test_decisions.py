"""Decisions of the planner and their evidence, on measured and on synthetic scenes."""

import csv
import json
import os
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.commands import (
    DEFAULT_STEPS,
    ComponentChoice,
    configured,
    layered,
    read_scene,
)
from crossgrad_core.registry.entries import build
from crossgrad_core.run.app import bundled_scene
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.exposures.tracks import gains as tracks
from crossgrad_plugins.exposures.tracks.gains import Fit, TrackGains
from crossgrad_plugins.planner import appearance, data, grouping
from crossgrad_plugins.planner.app import lines_of
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.length import FEWEST_VIEWS, PASSES, length
from crossgrad_plugins.planner.modes import DEPTH, Modes, modes_of
from crossgrad_plugins.planner.planner import PARTS, plan_of, planned
from crossgrad_plugins.planner.probe import Probe

#: A folder with scenes of these names, where there is one.
SCENES = Path(os.environ.get("CROSSGRAD_SCENES", "no-such-folder"))
#: Scene -> modes, what the cut separates, far / near, range; the spread of gains in stops, what
#: they take off the deviation, and the exposure. Measured on all training photos at full size.
MEASURED = {
    "city_hybrid": ("two modes", 0.950, 3.87, 10.49, 0.063, 0.072, "none"),
    "city_unimodal": ("one mode, continuous", 0.658, 2.94, 8.80, 0.040, 0.059, "none"),
    "boruszyn_kap": ("one mode, continuous", 0.645, 1.64, 3.53, 0.398, 0.575, "gain"),
    "ochota_kap_hybrid": ("two modes", 0.946, 2.14, 2.61, 1.456, 0.803, "gain"),
    "ochota_kap_hybrid_gain": ("two modes", 0.946, 2.14, 2.61, 0.094, 0.096, "none"),
    "brighton_beach": ("one mode, one distance", 0.751, 1.03, 1.05, 0.433, 0.734, "gain"),
}
#: Settings that the plan of a run without a length changes on these scenes.
FAR_FIRST = {
    "sampler": "horizon",
    "sampler.coarse": [5, 1],
    "grouping": "altitude",
    "grouping.cut": "otsu",
}
CHANGED = {
    "city_hybrid": {**FAR_FIRST, "max_views": 11_200},
    "city_unimodal": {"max_views": 6_500},
    "boruszyn_kap": {"exposure": "gain", "max_views": 2_400},
    "ochota_kap_hybrid": {"exposure": "gain", "max_views": 3_200},
    "ochota_kap_hybrid_gain": {"max_views": 3_200},
    "brighton_beach": {"exposure": "gain", "max_views": 1_400},
}
#: Scene, depth over focal length as a logarithm, and height of each training camera.
TABLE = Path(__file__).with_name("cameras.csv")
PAIRS_BY_HEIGHT = {"sampler": "near-far", "grouping": "altitude", "grouping.cut": "otsu"}
LENGTHS = {"steps", "max_views", "seconds"}
PARTS_OF_THE_TABLE = [
    *("modes", "pairs of views", "view schedule", "views per step", "operator"),
    *("exposure", "SH degree", "scale filter", "length"),
    *("initializer", "held out", "undistortion", "masks", "background"),
]


def modes_measured(name):
    """The modes of a scene by the distances and heights that were measured."""
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    # The copy with other brightness has the same cameras.
    own = [row for row in rows if row["scene"] == name.removesuffix("_gain")]
    return Modes(DEPTH, *(np.array([float(r[q]) for r in own]) for q in ("log_distance", "height")))


def modes_at(logs, heights=None):
    return Modes(DEPTH, np.asarray(logs), np.zeros(len(logs)) if heights is None else heights)


#: A probe by which near and far views differ.
PAIRS_PAY = Probe(rho=0.5, rho_low=0.2, rho_high=0.9, conflict=0.7, conflict_low=0.6)


def config_of(**given):
    return configured({"scene": "nowhere", **given})


def evidence_of(name, probe=None, **given):
    """The evidence of a scene that was measured, by its table."""
    evidence = Evidence(config_of(**given), posed_scene([]))
    vars(evidence)["modes"] = modes_measured(name)
    vars(evidence)["probe"] = probe
    return evidence


def length_of(photos, **given):
    views = [posed_view((i, 0, 0), f"{i}.png") for i in range(photos)]
    return length(Evidence(config_of(**given), posed_scene(views)))


def plan_for(scene, **given):
    """The plan of a run that has a length, of 3,000 steps where none is given."""
    length = {} if LENGTHS & given.keys() else {"steps": 3_000}
    return plan_of(config_of(**length, **given), scene)


@pytest.mark.parametrize("name", MEASURED)
def test_the_decision_on_distance_modes_matches_the_measured_scenes(name):
    choice, separability, ratio, spread, *_ = MEASURED[name]
    found = grouping.modes(evidence_of(name))
    assert found.choice == choice
    assert found.basis == "decided"
    assert found.figures["separability"] == pytest.approx(separability, abs=0.002)
    assert found.figures["far_over_near"] == pytest.approx(ratio, rel=0.01)
    assert found.figures["range"] == pytest.approx(spread, rel=0.01)


@pytest.mark.parametrize("name", MEASURED)
def test_the_exposure_decision_matches_the_measured_scenes(name, monkeypatch):
    *_, spread, reduction, choice = MEASURED[name]
    fit = Fit(np.array([-spread, spread]), 1.0, 1.0 - reduction, np.full(2, 0.01))
    measured = TrackGains(fit.gains, np.array([99, 99]), fit)
    monkeypatch.setattr(tracks, "deciding_gains", lambda scene: measured)
    scene = posed_scene([posed_view((0, 0, 0), seen=[0])], [(0, 1, 0)])
    found = appearance.exposure(Evidence(config_of(), scene))
    assert (found.choice, found.basis) == (choice, "decided")
    assert found.figures["spread_stops"] == pytest.approx(spread)
    assert found.figures["reduction"] == pytest.approx(reduction)
    assert dict(found.settings) == ({"exposure": "gain"} if choice == "gain" else {})


@pytest.mark.parametrize("name", MEASURED)
def test_the_plan_of_the_real_scenes_matches_the_measurements(name):
    if not (SCENES / name).is_dir():
        pytest.skip("CROSSGRAD_SCENES names no folder with this scene")
    config = configured({"scene": str(SCENES / name)})
    plan = plan_of(config, read_scene(config)[0])
    choice, separability, ratio, spread, *_, exposure = MEASURED[name]
    figures = plan.of_part("modes").figures
    assert plan.of_part("modes").choice == choice
    assert plan.of_part("exposure").choice == exposure
    assert plan.settings == CHANGED[name]
    assert figures["separability"] == pytest.approx(separability, abs=0.002)
    assert figures["far_over_near"] == pytest.approx(ratio, rel=0.01)
    assert figures["range"] == pytest.approx(spread, rel=0.01)


@pytest.fixture(scope="module")
def bundled():
    reading = {"max_size": 100}
    settings = {"scene": str(bundled_scene()), "data": reading, "steps": 3_000}
    config = configured(settings)
    return config, read_scene(config)[0]


def test_the_plan_of_the_bundled_scene_sets_the_gain_exposure(bundled):
    plan = plan_of(*bundled)
    assert [finding.part for finding in plan.findings] == PARTS_OF_THE_TABLE
    assert plan.of_part("modes").choice == "one mode, continuous"
    assert plan.of_part("pairs of views").basis == "decided"
    assert plan.of_part("exposure").choice == "gain"
    assert plan.settings == {"exposure": "gain"}
    assert plan.seconds > 0.0


def test_settings_of_the_user_are_kept_and_marked_in_the_table(bundled):
    config, scene = bundled
    mine = config.model_copy(update={"exposure": ComponentChoice(name="none")})
    plan = plan_of(mine, scene)
    assert plan.of_part("exposure").basis == "given"
    assert plan.of_part("exposure").choice == "none"
    assert planned(mine, scene) == []


def test_decisions_of_the_planner_become_settings(bundled):
    config, scene = bundled
    (row,) = planned(config, scene)
    assert (row.setting, row.value, row.override) == ("exposure", "gain", "--exposure none")
    decided, rows, _ = with_decisions(config, scene)
    assert decided.exposure.name == "gain"
    assert decided.decided["exposure"] == row.because
    assert rows[0] == row
    data = plan_of(config, scene).as_data()
    assert json.loads(json.dumps(data)) == data


def test_pairs_of_views_are_decided_only_with_a_gradient_probe():
    found = grouping.pairs(evidence_of("city_hybrid"))
    assert found.basis == "default"
    assert "--probe" in found.evidence
    assert not found.settings


@pytest.mark.parametrize(
    ("low", "rho", "high", "status", "changes"),
    [
        (0.2, 0.5, 0.9, "decided", PAIRS_BY_HEIGHT),
        (0.0, 0.02, 0.04, "decided", {}),
        (0.0, 0.2, 0.6, "default", {}),
        (np.nan, np.nan, np.nan, "default", {}),
    ],
)
def test_pairs_of_views_are_decided_by_the_whole_interval_of_rho(low, rho, high, status, changes):
    probe = Probe(rho=rho, rho_low=low, rho_high=high, noise_scale=50.0, conflict=0.5)
    found = grouping.pairs(evidence_of("city_hybrid", probe))
    assert found.basis == status
    assert dict(found.settings) == changes
    assert not grouping.pairs(evidence_of("city_unimodal", probe)).settings


def test_an_estimate_of_rho_below_zero_without_an_interval_decides_nothing():
    found = grouping.pairs(evidence_of("city_hybrid", Probe(rho=-0.0105, conflict=0.5)))
    assert (found.basis, dict(found.settings)) == ("default", {})
    assert "-0.011, 95 % interval none, the estimate is below 0" in found.evidence


def test_pairs_of_views_are_not_used_with_an_odd_number_of_views():
    probe = Probe(rho=0.5, rho_low=0.2, rho_high=0.9)
    found = grouping.pairs(evidence_of("city_hybrid", probe, views_per_step=3))
    assert not found.settings
    assert "even" in found.evidence


@pytest.mark.parametrize("noise", [0.4, 2.0, 640.0, np.inf])
def test_one_view_per_step_is_chosen_for_any_gradient_noise(noise):
    probe = Probe(noise_scale=noise, rho=0.0, rho_low=0.0, rho_high=0.0)
    found = grouping.views_per_step(evidence_of("city_unimodal", probe))
    assert (found.choice, found.basis, found.settings) == ("1", "decided", {})
    assert found.figures == {"noise_scale": noise}


def test_a_sampler_of_pairs_sets_two_views_per_step():
    probe = Probe(rho=0.5, rho_low=0.2, rho_high=0.9)
    found = grouping.views_per_step(evidence_of("city_hybrid", probe))
    # The sampler brings them: nothing else is to be set.
    assert (found.choice, found.basis, found.settings) == ("2", "decided", {})


@pytest.mark.parametrize("name", ["backward", "batch_rule", "densify_views"])
def test_two_views_per_step_are_reported_for_pairs_with_any_other_setting(name):
    value = {"backward": "joint", "batch_rule": "sqrt", "densify_views": "one"}[name]
    evidence = evidence_of("city_hybrid", PAIRS_PAY, **{name: value})
    assert grouping.views_per_step(evidence).choice == "2"


def test_the_planner_counts_the_views_per_step_of_the_planned_run():
    assert grouping.views_of_steps(evidence_of("city_hybrid")).counts == (1,)
    asked = evidence_of("city_hybrid", operator={"name": "pcgrad"})
    assert grouping.views_of_steps(asked).counts == (2,)
    pairs = evidence_of("city_hybrid", PAIRS_PAY, max_views=6_000)
    assert grouping.views_of_steps(pairs).counts == (2,)


@pytest.mark.parametrize("name", ["sampler", "operator"])
def test_views_per_step_are_not_decided_if_the_user_chose_sampler_or_operator(name):
    chosen = {"sampler": "near-far", "operator": "pcgrad"}[name]
    evidence = evidence_of("city_hybrid", **{name: {"name": chosen}})
    assert grouping.views_per_step(evidence).basis == "default"


def test_pairs_of_near_and_far_views_are_rejected_if_one_group_is_much_smaller():
    found = grouping.pairs(evidence_of("ochota_kap_hybrid", PAIRS_PAY))
    assert (found.basis, dict(found.settings)) == ("default", {})
    assert "the smaller mode has 34% of the views" in found.evidence
    assert "1.5 times as often" in found.evidence


@pytest.mark.parametrize(
    ("given", "choice"),
    [
        ({"sampler": {"name": "near-far"}}, "symmetric"),
        ({"sampler": {"name": "near-far", "alternating": True}}, "sum"),
        ({"sampler": {"name": "random"}, "views_per_step": 2}, "sum"),
        ({"backward": "joint"}, "sum"),
        ({"sampler": {"name": "near-far"}, "backward": "joint"}, "sum"),
    ],
)
def test_gradient_projection_is_chosen_for_pairs_from_the_sampler_of_the_user(given, choice):
    assert grouping.operator(evidence_of("city_hybrid", PAIRS_PAY, **given)).choice == choice


@pytest.mark.parametrize(
    ("given", "grouping"),
    [
        ({}, {"name": "altitude", "cut": "otsu"}),
        ({"sampler": {"name": "near-far"}}, {"name": "radial"}),
        ({"sampler": {"name": "random"}}, {"name": "altitude", "cut": "otsu"}),
        ({"grouping": {"name": "percentile", "q": 20}}, {"name": "percentile", "q": 20}),
    ],
)
def test_the_gradient_probe_uses_the_grouping_of_the_run(given, grouping):
    assert evidence_of("city_hybrid", **given).grouping.model_dump() == grouping


@pytest.mark.parametrize(
    ("name", "grouping"), [("city_hybrid", "altitude"), ("ochota_kap_hybrid", "footprint")]
)
def test_distance_modes_are_separated_by_the_grouping_with_the_clearest_gap(name, grouping):
    assert evidence_of(name).grouping.name == grouping


@pytest.mark.sampled(5)
@pytest.mark.parametrize("views", [12, 30, 60, 200])
@pytest.mark.parametrize("law", ["uniform", "normal", "exponential", "lognormal"])
def test_camera_distances_without_a_gap_form_one_mode(law, views):
    rng = np.random.default_rng(views)
    draw = {
        "uniform": lambda: rng.uniform(0.0, 2.5, views),
        "normal": lambda: rng.normal(0.0, 1.0, views),
        "exponential": lambda: rng.exponential(1.0, views),
        "lognormal": lambda: rng.lognormal(0.0, 0.5, views),
    }[law]
    wrong = sum(modes_at(draw(), draw()).two for _ in range(200))
    # 1 % by distance and 1 % by height, and the error of 200 trials.
    assert wrong <= 12


@pytest.mark.parametrize("views", [12, 30, 60, 200])
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_camera_distances_with_a_gap_form_two_modes(share, views):
    rng = np.random.default_rng(views)
    far = np.arange(views) < round(share * views)
    found = [modes_at(rng.normal(0.0, 0.07, views) + far) for _ in range(100)]
    assert sum(each.two for each in found) >= 98
    # Where they part is where they are cut, however many are on either side.
    (shares,) = {round(each.cut.share * views) for each in found if each.two}
    assert shares == round(share * views)


@pytest.mark.parametrize("views", [10, 20, 30, 50, 100])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_tenth_of_the_views_is_enough_for_a_near_or_far_mode(views, side):
    far = np.arange(views) < views // 10
    found = modes_at(np.linspace(0.0, 0.1, views) + 2.0 * side * far)
    assert found.two
    assert found.cut.share == 0.1


@pytest.mark.parametrize("stragglers", [1, 2, 5])
def test_a_few_outlier_cameras_do_not_form_a_distance_mode(stragglers):
    logs = np.random.default_rng(5).normal(0.0, 0.1, 60)
    logs[:stragglers] += 3.0
    assert not modes_at(logs).two
    assert modes_at(logs).one


@pytest.mark.parametrize(
    ("conflict_low", "rho_low", "choice"),
    [(0.6, 0.2, "symmetric"), (0.45, 0.2, "sum"), (0.6, 0.0, "sum")],
)
def test_gradient_projection_requires_pairs_and_conflict_beyond_chance(
    conflict_low, rho_low, choice
):
    probe = Probe(rho=0.5, rho_low=rho_low, rho_high=0.9, conflict=0.7, conflict_low=conflict_low)
    assert grouping.operator(evidence_of("city_hybrid", probe)).choice == choice
    assert grouping.operator(evidence_of("city_unimodal", probe)).choice == "sum"


def test_a_failed_gradient_probe_decides_nothing():
    probe = Probe(problem="a probe needs at least two training views in each group")
    evidence = evidence_of("city_hybrid", probe)
    for part in (grouping.pairs, grouping.operator):
        found = part(evidence)
        assert found.basis == "default"
        assert probe.problem in found.evidence
    assert probe.problem in grouping.views_per_step(evidence).evidence


def test_an_infinite_noise_scale_is_reported_as_beyond_all_views():
    probe = Probe(rho=0.5, rho_low=0.1, rho_high=0.9, noise_scale=inf, conflict=0.5)
    found = grouping.views_per_step(evidence_of("city_unimodal", probe))
    assert found.evidence.endswith("gradient noise scale larger than all views: no common part")


def orbit(count=40):
    """Cameras on a half sphere around a cloud, as Blender's scenes have them."""
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2])
    cloud = rng.uniform(-0.5, 0.5, (60, 3))
    views = [
        posed_view(4.0 * d, f"{i:03}.png", forward=-d, seen=range(60))
        for i, d in enumerate(directions)
    ]
    return posed_scene(views, cloud)


def street(count=30):
    """A walk along one street: photos of both sides, between 4 and 25 units away."""
    rng = np.random.default_rng(3)
    depths = np.exp(rng.uniform(np.log(4.0), np.log(25.0), count))
    cloud, views = [], []
    for i, depth in enumerate(depths):
        side = 1.0 if i % 2 else -1.0
        first = len(cloud)
        cloud += [(2.0 * i + x, side * depth, z) for x in (-0.5, 0.0, 0.5) for z in (0.5, 1.5)]
        seen = range(first, first + 6)
        views.append(posed_view((2.0 * i, 0, 1.7), f"{i:03}.png", forward=(0, side, 0), seen=seen))
    return posed_scene(views, cloud)


def test_a_scene_with_cameras_in_an_orbit_has_one_distance():
    plan = plan_for(orbit())
    assert plan.of_part("modes").choice == "one mode, one distance"
    assert plan.of_part("pairs of views").choice == "epoch"
    assert plan.of_part("scale filter").basis == "decided"
    assert not plan.settings


def test_the_planner_selects_the_background_with_which_photos_were_blended():
    note = "photos: 40 of 40 photos with transparency: blended over RGB (1.0, 1.0, 1.0)"
    scene = replace(orbit(), notes=(note,))
    assert plan_for(scene).settings == {"background": "white"}
    assert plan_for(scene, background="black").of_part("background").basis == "given"
    assert not plan_for(scene, background="black").settings


def test_a_scene_of_street_photos_has_one_distance_mode():
    plan = plan_for(street())
    assert plan.of_part("modes").choice == "one mode, continuous"
    assert plan.of_part("modes").figures["range"] > 3.0
    assert plan.of_part("operator").choice == "sum"
    assert not plan.settings


def test_a_view_without_points_does_not_prevent_pairs_of_views():
    rng = np.random.default_rng(1)
    cloud = rng.uniform(-1.0, 1.0, (200, 3))
    views = [
        posed_view((4.0 * (1 + i % 2) ** 2, 0.1 * i, 0.0), f"{i}.png", forward=(-1, 0, 0))
        for i in range(20)
    ]
    blind = posed_view((4.0, 0.5, 0.0), "blind.png", forward=(1, 0, 0))
    scene = posed_scene([*views, blind], cloud)
    cut = modes_of(scene).cut
    assert cut.two
    choice = cut.grouping
    rule = build("groupings", choice.name, choice.options).fit(scene, rng)
    assert "without SfM points join the group of the nearest other view: 1" in rule.notes[0]
    assert rule.label(blind) == "near"
    assert rule.labels(views) == ("near", "far") * 10


def test_a_scene_of_street_and_aerial_photos_has_two_distance_modes():
    low = street(15)
    cloud = low.points
    high = [
        posed_view((x, y, 90.0), f"a{x}{y}.png", forward=(0, 0.1, -1), seen=range(len(cloud)))
        for x in (0.0, 10.0, 20.0, 30.0)
        for y in (-9.0, 0.0, 9.0)
    ]
    plan = plan_for(posed_scene([*low.views, *high], cloud))
    assert plan.of_part("modes").choice == "two modes"
    assert plan.of_part("modes").figures["far_over_near"] > 4.0


@pytest.mark.parametrize("count", [1, 2, 9])
def test_a_single_photo_starts_from_random_points_and_several_photos_are_triangulated(count):
    scene = posed_scene([posed_view((i, i * i, 0), f"{i}.png") for i in range(count)])
    plan = plan_for(scene)
    changes = {"data.init": "random"} if count == 1 else {"initializer": "triangulated"}
    assert plan.settings == changes
    assert plan.of_part("exposure").basis == "default"
    decided, _, _ = with_decisions(config_of(steps=3_000), scene)
    assert decided.data.init == ("random" if count == 1 else "points")


@pytest.mark.parametrize("photos", [1, 9, 10, 11, 40])
def test_a_run_without_a_length_gets_a_length_from_its_photos(photos):
    most = max(FEWEST_VIEWS, PASSES * photos)
    found = length_of(photos)
    assert (found.choice, found.basis) == (f"{most:,} views", "decided")
    assert dict(found.settings) == {"max_views": most}
    assert found.saved == f"{1 - most / DEFAULT_STEPS:.0%} of the views of 30,000 steps"
    decided, _, _ = with_decisions(config_of(), orbit(photos))
    assert (decided.max_views, decided.steps, decided.seconds) == (most, None, None)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("photos", "stays"), [(299, False), (300, True), (2_000, True)])
def test_the_planned_length_is_never_longer_than_the_default(photos, stays):
    found = length_of(photos)
    assert found.basis == "decided"
    assert (found.choice == "30,000 steps") == stays
    assert bool(found.settings) != stays


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("views", "photos"), [(2, 600), ("1..2@0.5", 450), ("2..1@0.9", 570)])
def test_the_planned_length_counts_every_view_of_a_step(views, photos):
    assert length_of(photos - 1, views_per_step=views).choice == f"{100 * photos - 100:,} views"
    assert length_of(photos, views_per_step=views).choice == "30,000 steps"


@pytest.mark.parametrize("seconds", [0.5, 60.0])
def test_given_seconds_are_an_upper_limit_of_the_planned_length(seconds):
    found = length_of(20, seconds=seconds)
    assert found.choice == f"2,000 views within {seconds:g} s"
    assert dict(found.settings) == {"max_views": 2_000}
    decided, _, _ = with_decisions(config_of(seconds=seconds), orbit(20))
    assert (decided.max_views, decided.seconds, decided.steps) == (2_000, seconds, None)


@pytest.mark.parametrize("mine", [{"recipe": {"name": "published"}}, {"schedule": "absolute"}])
@pytest.mark.parametrize(("seconds", "choice"), [(None, "30,000 steps"), (60.0, "60 s")])
def test_published_schedules_keep_their_length(mine, seconds, choice):
    found = length_of(20, **mine, **({} if seconds is None else {"seconds": seconds}))
    assert (found.choice, found.basis, dict(found.settings)) == (choice, "default", {})
    assert "published" in found.evidence


def test_views_and_seconds_given_by_the_user_are_kept():
    found = length_of(20, seconds=60.0, max_views=500)
    assert (found.choice, found.basis) == ("500 views within 60 s", "given")


@pytest.mark.parametrize("mine", [{"steps": 7}, {"max_views": 90_000}])
def test_given_steps_and_views_are_kept_exactly(mine):
    found = length_of(20, **mine)
    assert (found.basis, dict(found.settings)) == ("given", {})
    decided, _, _ = with_decisions(config_of(**mine), orbit(20))
    assert (decided.steps, decided.max_views) == (mine.get("steps"), mine.get("max_views"))


def test_a_scene_without_photos_keeps_the_default_length():
    assert length(Evidence(config_of(), posed_scene([]))).basis == "default"


@pytest.mark.parametrize("backbone", ["scaffold", "mip"])
def test_a_backbone_chosen_by_the_user_is_kept(backbone):
    plan = plan_for(orbit(), backbone={"name": backbone})
    assert not plan.settings
    assert plan.of_part("scale filter").basis == "given"


@pytest.mark.parametrize("width", [60, 80, 109, 110, 120, 200])
def test_the_table_fits_the_terminal(width):
    lines = list(lines_of(plan_for(street(), steps=50), width))
    assert max(map(len, lines)) <= width
    text = " ".join(lines)
    assert all(part in text for part in PARTS_OF_THE_TABLE)
    assert "no settings changed" in text


def test_every_decision_states_its_reason_and_how_to_override_it():
    for finding in plan_for(street()).findings:
        assert finding.evidence
        assert finding.rule
        assert finding.source
        assert finding.force
        assert bool(finding.because) == bool(finding.settings)


_COORDINATE = st.floats(-1e6, 1e6, allow_nan=False, width=32)
_POINT = st.tuples(_COORDINATE, _COORDINATE, _COORDINATE)
_GIVEN = st.fixed_dictionaries(
    {},
    optional={
        "steps": st.integers(1, 40_000),
        "views_per_step": st.sampled_from([1, 2, 3, "1..2@0.5"]),
        "exposure": st.sampled_from(["none", "gain"]),
        "backbone": st.sampled_from(["vanilla", "scaffold", "mip"]),
        "background": st.sampled_from(["white", "0.1,0.2,0.3"]),
        "max_gaussians": st.sampled_from([10, "auto"]),
        "backbone.sh_degree": st.integers(0, 3),
    },
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    st.lists(_POINT, min_size=1, max_size=14),
    st.lists(_POINT, max_size=6),
    _GIVEN,
    st.lists(st.text(max_size=30), max_size=3),
)
def test_the_planner_handles_random_scenes(centers, points, asked, notes):
    if asked.get("backbone") == "scaffold":
        asked.pop("backbone.sh_degree", None)
    views = [
        posed_view(center, f"{i}.png", seen=range(len(points) if i % 2 else 0))
        for i, center in enumerate(centers)
    ]
    scene = replace(posed_scene(views, points), notes=tuple(notes))
    config = configured(layered([{"scene": "nowhere", **asked}]))
    plan = plan_of(config, scene)
    json.dumps(plan.as_data(), allow_nan=False)
    assert len(plan.findings) == len(PARTS)
    decided = configured(plan.applied_to({"scene": "nowhere", **asked}))
    for name in config.model_fields_set - {"backbone", "scene"}:
        assert getattr(decided, name) == getattr(config, name)


@pytest.mark.parametrize(
    ("decides", "setting", "value"),
    [
        (data.start, "init", "random"),
        (data.held_out, "split", "stratified"),
        (data.held_out, "test_every", 4),
    ],
)
def test_settings_in_the_group_data_given_by_the_user_are_not_changed_by_the_planner(
    decides, setting, value
):
    evidence = Evidence(config_of(data={setting: value}), posed_scene([]))
    assert decides(evidence).basis == "given"
