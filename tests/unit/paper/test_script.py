"""benchmarks/paper.py: rates from the tuned arms, the best methods, what is left to do."""

import argparse

import pytest
from support.paper_runs import SCENES

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.grid import Arm, Grid

FACTORS = {
    "two random views": {"city": 3.0, "town": 6.0},
    "one view, 2x stretched": {"city": 1.5, "town": 3.0},
    "scaffold, one view": {"city": 0.75, "town": 0.75},
}


def grid(*arms):
    return Grid.model_validate(
        {"scenes": ["/scenes/city", "/scenes/town"], "arms": [{"name": name} for name in arms]}
    )


def test_an_arm_gets_the_factors_of_its_tuned_arm_by_scene(modules):
    plan = modules.data.read_plan()
    names = ["one view, 2x stretched", "near and far by turns", "cagrad"]
    rates = {name: modules.paper.own_rate(name, plan, FACTORS) for name in names}
    found = modules.paper.with_rates(grid(*names), rates, FACTORS)
    factors = [[own["rate_factor"] for own in arm.by_scene.values()] for arm in found.arms]
    assert factors == [[1.5, 3.0], [1.5, 3.0], [3.0, 6.0]]


def test_a_scene_without_tuning_is_refused(modules):
    bad = Grid.model_validate({"scenes": ["/scenes/wood"], "arms": [{"name": "cagrad"}]})
    with pytest.raises(UserError, match="not tuned"):
        modules.paper.with_rates(bad, {"cagrad": "two random views"}, FACTORS)


def test_backbones_are_combined_with_all_methods_and_use_rates_of_similar_arms(modules):
    plan = modules.data.read_plan()
    methods = [
        Arm(name="one view, 2x stretched", settings={"views": 1, "observers": ["diagnostics"]}),
        Arm(name="cagrad", settings={"views": 2, "operator": "cagrad"}),
    ]
    backbones = Grid.model_validate(
        {"arms": [{"name": n, "settings": {"backbone": n}} for n in ("mip", "octree")]}
    )
    found = modules.paper.with_methods(backbones, methods)
    assert [arm.name for arm in found.arms] == [
        *("mip, one view, 2x stretched", "mip, cagrad"),
        *("octree, one view, 2x stretched", "octree, cagrad"),
    ]
    assert found.arms[0].settings == {"views": 1, "backbone": "mip"}
    assert found.arms[3].settings == {"views": 2, "operator": "cagrad", "backbone": "octree"}
    rates = [modules.paper.rate_of(arm, methods, plan) for arm in found.arms]
    assert rates == [
        *("one view, 2x stretched", "two random views"),
        *("scaffold, one view", "scaffold, two random views"),
    ]


@pytest.fixture
def paper(modules, tmp_path):
    def make(**given):
        options = {
            "only": None, "scenes": tmp_path / "scenes", "scene": None, "seed": None, "set": None,
            "workers": 2, "out": tmp_path / "out", "kept": tmp_path / "kept",
            "page": tmp_path / "docs" / "paper.md", **given,
        }  # fmt: skip
        return modules.paper.Paper(argparse.Namespace(**options))

    return make


def test_the_estimated_time_excludes_finished_runs_in_packed_tables(
    paper, planted, modules, capsys
):
    scenes = [f"/scenes/{name}" for name in SCENES[:2]]
    found = paper(scene=scenes, only=["views"])

    def left():
        found.tell()
        *_, views, total = capsys.readouterr().out.splitlines()
        assert views.startswith("views") and " 48 runs" in views and "on 2 cores" in total
        return float(views.split()[-2])

    before = left()
    same = {"clock": "cpu", "min_refinements": 6, "data": {"max_size": 400}}
    same |= {"densifier": {"name": "adc"}}
    settings = {
        "one view, 60 s": {**same, "sampler": {"name": "epoch"}},
        "two random views, 60 s": {**same, "sampler": {"name": "random"}, "views_per_step": 2},
    }
    arms = dict.fromkeys(settings, 0.0)
    sweep = planted("views", arms, SCENES[:2], settings=settings, planned=60.0)
    modules.paper.pack(sweep, found.place.archive("views"))
    found.unpack()
    assert before - left() == pytest.approx(12 * (60 + modules.paper.BESIDES) / 3600, abs=0.011)


def test_the_page_can_be_written_without_runs(paper):
    found = paper()
    found.write_page()
    text = found.place.page.read_text(encoding="utf-8")
    assert text.startswith("# The paper, row by row") and "**0 of " in text


def test_best_methods_are_chosen_only_after_all_candidates_ran(paper, planted):
    found = paper(scene=["/scenes/city"])
    assert found._best(found.results(), found.grids()) == []


def test_an_unknown_grid_is_refused(paper):
    with pytest.raises(UserError, match="no such grid"):
        paper(only=["view"]).check()
