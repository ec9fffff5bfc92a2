"""Faults of third-party plugins outside a step end in one message and affect no other plugin."""

import csv
import json
import sys

import pytest
from support.commands import ended
from support.distributions import write_distribution
from support.scenes import write_tiny_scene

SOURCE = """
import numpy as np
import torch
from crossgrad_core.plugin import (
    Densifier, ViewSample, Edit, Figure, Grouping, Loss, Metric, Observer, Rasterizer, Reader,
    Resolution, Rows, GroupingRule, Sampler, UserError, hookimpl,
)

class TensorMetric(Metric):
    figure = Figure("tensor", "tensor")

    def measure(self, compared):
        return torch.tensor(0.5)

class NumpySampler(Sampler):
    def sample(self, context, state):
        drawn = context.rng.integers(len(context.scene.train_views), size=1)
        return ViewSample(tuple(drawn)), state

class Behind(Sampler):
    def sample(self, context, state):
        return ViewSample((len(context.scene.train_views),)), state

class Before(Sampler):
    def sample(self, context, state):
        return ViewSample((-1,)), state

class Fewer(Grouping):
    def fit(self, scene, rng, probe=None):
        return GroupingRule(lambda views: ("near", "near", "far", "far"))

class Failing(Grouping):
    def fit(self, scene, rng, probe=None):
        raise ValueError("nothing fits")

class Words(Observer):
    @hookimpl
    def crossgrad_validate_selection(self, selection):
        return "this is no list"

class Objecting(Observer):
    @hookimpl
    def crossgrad_validate_selection(self, selection):
        raise RuntimeError("no answer")

class Steps(Observer):
    @hookimpl
    def crossgrad_step_end(self, record):
        if record.step > 1:
            raise ZeroDivisionError("nothing to divide")

class Around(Observer):
    @hookimpl(wrapper=True)
    def crossgrad_densify(self, context):
        answer = yield
        if context.step > 1:
            raise LookupError("nothing to look up")
        return answer

class Asks(Observer):
    @hookimpl
    def crossgrad_after_step(self, context):
        if context.step > 1:
            raise UserError("this observer needs a longer run")

class Unfit(Resolution):
    def fitted_to(self, scene):
        raise KeyError("scene")

    def scales(self, context, state):
        return (1.0,) * len(context.draw.views), state

class Infinite(Loss):
    def loss(self, render, photo, mask, weights):
        return render.sum() * float("inf")

class Vector(Loss):
    def loss(self, render, photo, mask, weights):
        return render.sum(dim=0)

class Typo(Densifier):
    def densify(self, context, state):
        return Edit(values={"mean": Rows(context.parameters["means"])}), state

class Emptying(Densifier):
    def densify(self, context, state):
        return Edit(source=torch.zeros(0, dtype=torch.int64)), state

class Picky(Reader):
    def accepts(self, path):
        raise ValueError("what is this")

    def read(self, path, options):
        raise ValueError("what is this")

class Slow(Rasterizer):
    @classmethod
    def speed(cls, device):
        raise ValueError("who knows")

    def render(self, gaussians, camera, background, outputs=frozenset()):
        raise ValueError("who knows")
"""
PLUGINS = {
    "metrics": {"tensor": "TensorMetric"},
    "samplers": {"numpy": "NumpySampler", "behind": "Behind", "before": "Before"},
    "groupings": {"fewer": "Fewer", "failing": "Failing"},
    "observers": {
        "words": "Words",
        "objecting": "Objecting",
        "steps": "Steps",
        "around": "Around",
        "asks": "Asks",
    },
    "resolutions": {"unfit": "Unfit"},
    "losses": {"infinite": "Infinite", "vector": "Vector"},
    "densifiers": {"typo": "Typo", "emptying": "Emptying"},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=9)


def installed(monkeypatch, folder, plugins, **more):
    named = {
        slot: {name: f"made_up_faulty:{value}" for name, value in each.items()}
        for slot, each in plugins.items()
    }
    modules = {"made_up_faulty": SOURCE, "made_up_leaving": "import sys\nsys.exit(0)\n"}
    write_distribution(folder, "faulty-package", {**named, **more}, modules)
    monkeypatch.syspath_prepend(folder)
    for module in modules:
        sys.modules.pop(module, None)


def run(scene, out, *options):
    given = ("--steps", "4", "--threads", "1", "--initializer", "points", "-q", "--out", out)
    return ended("run", scene, *given, *options)


def test_a_metric_value_is_a_number_in_every_file(scene, tmp_path, monkeypatch):
    installed(monkeypatch, tmp_path / "site", PLUGINS)
    assert run(scene, tmp_path / "run", "--metrics", "tensor") == 0
    with (tmp_path / "run" / "per_view.csv").open() as file:
        assert {row["tensor"] for row in csv.DictReader(file)} == {"0.5"}


def test_numbers_of_views_may_be_numpy_integers(scene, tmp_path, monkeypatch):
    installed(monkeypatch, tmp_path / "site", PLUGINS)
    assert run(scene, tmp_path / "run", "--sampler", "numpy", "--stop-after", "2") == 0
    assert ended("run", "--resume", tmp_path / "run", "-q") == 0


def test_a_run_that_loses_all_primitives_reports_so(scene, tmp_path, monkeypatch, capsys):
    installed(monkeypatch, tmp_path / "site", PLUGINS)
    assert run(scene, tmp_path / "run", "--densifier", "emptying") == 0
    words = "no Gaussian is left: check densifier emptying"
    assert words in capsys.readouterr().err
    assert words in (tmp_path / "run" / "log.txt").read_text()
    assert run(scene, tmp_path / "usual") == 0
    assert "no Gaussian" not in capsys.readouterr().err


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--sampler", "behind"), "where:    sampler behind, step"),
        (("--sampler", "before"), "where:    sampler before, step"),
        (("--sampler", "near-far", "--grouping", "fewer"), "4 labels of 7 training views"),
        (("--sampler", "near-far", "--grouping", "failing"), "ValueError: nothing fits"),
        (("--observe", "words"), "found:    this is no list\n"),
        (("--observe", "objecting"), "RuntimeError: no answer"),
        (
            ("--observe", "objecting"),
            "in hook crossgrad_validate_selection of observer objecting, from faulty-package 1.0",
        ),
        (("--resolution", "unfit"), "a plugin of package faulty-package 1.0 raised an error"),
        (("--resolution", "unfit"), "made_up_faulty.py:68"),
        (("--loss", "infinite"), "the photometric loss is not finite"),
        (("--loss", "infinite", "--seconds", "1"), "the photometric loss is not finite"),
        (("--loss", "vector"), "a trial step failed before the training started"),
        (("--densifier", "typo"), "there is no tensor 'mean' with one row per Gaussian"),
    ],
    ids=lambda case: " ".join(case) if isinstance(case, tuple) else "",
)
def test_a_faulty_plugin_gives_one_error_before_anything_is_written(
    scene, tmp_path, monkeypatch, capsys, options, words
):
    installed(monkeypatch, tmp_path / "site", PLUGINS)
    length = () if "--seconds" in options else ("--steps", "4")
    given = ("--threads", "1", "--initializer", "points", "-q", "--out", tmp_path / "run")
    assert ended("run", scene, *length, *given, *options) == 2
    said = capsys.readouterr().err
    assert words in said and "to do:" in said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "case",
    [
        ("steps", "step_end", "ZeroDivisionError: nothing to divide"),
        ("around", "densify", "LookupError: nothing to look up"),
        ("asks", "after_step", "this observer needs a longer run"),
    ],
)
def test_a_hook_that_fails_in_training_is_named_with_its_plugin(
    scene, tmp_path, monkeypatch, capsys, case
):
    observer, hook, words = case
    installed(monkeypatch, tmp_path / "site", PLUGINS)
    assert run(scene, tmp_path / "run", "--observe", observer) == 1
    error = json.loads((tmp_path / "run" / "summary.json").read_text())["error"]
    whose = f"in step 2: in hook crossgrad_{hook} of observer {observer}, from faulty-package 1.0: "
    assert error.startswith(whose) and words in error
    assert whose in capsys.readouterr().err


def test_a_plugin_that_fails_during_selection_does_not_block_other_plugins(
    scene, tmp_path, monkeypatch, capsys
):
    # They are asked by every run that leaves the choice to crossgrad.
    readers = {"lost": "made_up_lost:A", "picky": "made_up_faulty:Picky"}
    installed(monkeypatch, tmp_path / "site", {"rasterizers": {"slow": "Slow"}}, readers=readers)
    assert run(scene, tmp_path / "run") == 0
    said = capsys.readouterr().err
    assert "note: reader picky cannot be used: ValueError: what is this" in said
    assert "note: reader lost cannot be used: reader lost cannot be imported" in said
    notes = json.loads((tmp_path / "run" / "summary.json").read_text())["notes"]
    assert "rasterizer slow is not used: ValueError: who knows" in notes


def test_a_plugin_module_that_calls_exit_on_import_does_not_end_the_command(
    scene, tmp_path, monkeypatch, capsys
):
    leaving = {slot: {"leaving": "made_up_leaving:A"} for slot in ("observers", "commands")}
    installed(monkeypatch, tmp_path / "site", {}, **leaving)
    for command in (("run", scene, "--observe", "leaving"), ("leaving",)):
        assert ended(*command) == 2
        assert "leaving cannot be imported" in capsys.readouterr().err
