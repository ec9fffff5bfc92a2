"""A run says where its grouping splits values that form only one group."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.slots.grouping import Grouping, GroupingRule, Quantity
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import posed_scene, posed_view, sample_scene
from crossgrad_core.training.modes import mode_note

CENTERS = Path(__file__).with_name("camera_centers.csv")
#: Those that split one number per view.
BY_DISTANCE = ("radial", "percentile", "anchors", "terciles", "gmm")


def layout(name):
    """A scene with the training cameras of a real or rendered one."""
    with CENTERS.open(newline="") as file:
        rows = csv.DictReader(line for line in file if not line.startswith("#"))
        centers = [[float(row[axis]) for axis in "xyz"] for row in rows if row["scene"] == name]
    return posed_scene([posed_view(center, f"{i}.png") for i, center in enumerate(centers)])


def at_heights(heights, **options):
    """Cameras above each other that look at a point far off, at one distance from all."""
    views = [posed_view((0, 0, h), f"{i}.png", **options) for i, h in enumerate(heights)]
    return posed_scene(views)


def looking_from(distances):
    """Cameras on a line that see one point each, at these depths."""
    views = [
        posed_view((i, -depth, 0.0), f"{i}.png", seen=[i]) for i, depth in enumerate(distances)
    ]
    return posed_scene(views, [(i, 0.0, 0.0) for i in range(len(distances))])


def notes(name, scene):
    return mode_note(name, build("groupings", name, {}), scene)


@pytest.mark.parametrize("grouping", BY_DISTANCE)
@pytest.mark.parametrize(
    ("name", "figure"), [("city_unimodal", "0.51 over 65"), ("brighton_beach", "0.53 over 15")]
)
def test_a_split_of_one_mode_of_distances_is_noted_with_its_bimodality(name, figure, grouping):
    (note,) = notes(grouping, layout(name))
    assert f"grouping {grouping} splits values that form only one group" in note
    assert f"bimodality of the log distance from the mean camera is {figure} training" in note
    assert "below 0.555" in note and "arbitrary" in note


@pytest.mark.parametrize("grouping", BY_DISTANCE)
def test_a_split_of_two_modes_of_distances_is_not_noted(grouping):
    assert notes(grouping, layout("city_hybrid")) == ()


def test_modes_of_heights_are_tested_along_the_axis_of_the_grouping():
    one = at_heights(np.random.default_rng(0).normal(size=40))
    (note,) = notes("altitude", one)
    assert "the bimodality of the height is 0." in note
    assert notes("altitude", at_heights([*np.linspace(0, 1, 20), *np.linspace(9, 10, 20)])) == ()
    across = build("groupings", "altitude", {"up": (1.0, 0.0, 0.0)})
    assert mode_note("altitude", across, one) == ()


def test_modes_of_footprints_are_tested_on_the_logarithm():
    depths = np.exp(np.random.default_rng(1).normal(size=40))
    (note,) = notes("footprint", looking_from(depths))
    assert "the bimodality of the log depth over focal length is 0." in note
    assert notes("footprint", looking_from([1.0, 1.1, 1.2, 1.3, 1.4] * 4 + [90.0, 99.0] * 10)) == ()


@pytest.mark.parametrize("grouping", ["kmeans", "lists", "conflict-signature"])
def test_groupings_of_more_than_one_quantity_are_not_tested_for_modes(grouping):
    assert notes(grouping, layout("city_unimodal")) == ()


@pytest.mark.parametrize("size", [4, 6, 8, 9])
def test_a_split_of_few_cameras_with_two_modes_is_not_noted(size):
    assert notes("altitude", at_heights([0.0, 10.0] * (size // 2) + [0.0] * (size % 2))) == ()


def test_a_split_of_few_cameras_with_one_mode_is_noted():
    (note,) = notes("altitude", at_heights([0.0, 1.9, 2.0, 2.0, 2.1, 4.0]))
    assert "over 6 training views" in note


@pytest.mark.parametrize("heights", [[1.0, 2.0, 3.0], [1.0] * 12])
def test_altitude_gets_no_note_about_modes_without_enough_evidence(heights):
    assert notes("altitude", at_heights(heights)) == ()


def test_a_camera_without_a_value_is_ignored_by_the_test_for_modes():
    views = [*layout("city_unimodal").views]
    middle = np.mean([view.camera.center.numpy() for view in views], axis=0)
    scene = posed_scene([*views, posed_view(middle, "middle.png")])
    assert not np.isfinite(build("groupings", "radial", {}).quantity(scene, scene.views).values[-1])
    (note,) = notes("radial", scene)
    assert "over 65 training views" in note


class Sized(Grouping):
    """A third party's: by the number of points that a view sees."""

    def fit(self, scene, rng, probe=None):
        return GroupingRule(
            lambda views: tuple("near" if len(v.seen) > 3 else "far" for v in views)
        )

    def quantity(self, scene, views):
        return Quantity("the number of points", np.array([float(len(v.seen)) for v in views]))


def test_a_third_party_grouping_is_tested_for_modes():
    views = [posed_view((0, 0, i), f"{i}.png", seen=range(i)) for i in (2, 3, 3, 3, 3, 3, 4, 4, 4)]
    (note,) = mode_note("sized", Sized(), posed_scene(views))
    assert "the number of points" in note


def test_the_note_about_one_distance_mode_is_recorded_in_the_run():
    settings = {"steps": 5, "sampler": {"name": "near-far"}}
    scene = replace(layout("city_unimodal"), points=sample_scene().points)
    near_far = assemble(RunConfig.model_validate(settings), scene, "none")
    assert sum("splits values that form only one group" in note for note in near_far.notes) == 1
    plain = assemble(RunConfig.model_validate({"steps": 5}), sample_scene(), "none")
    assert not any("one mode" in note for note in plain.notes)
