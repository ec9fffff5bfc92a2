"""A run that parts of another package trained is looked at without them, and not continued."""

import sys

import pytest
from support.commands import ended
from support.distributions import write_distribution
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.registry.entries import load
from crossgrad_core.run.load_run import without_missing

#: What only trains, and what only measures or listens.
TRAINS = {
    "samplers": "epoch",
    "operators": "pcgrad",
    "densifiers": "adc",
    "losses": "l1-ssim",
    "initializers": "fill-gaps",
    "resolutions": "full",
}
SOURCE = """
from crossgrad_core.plugin import Figure, Metric, Observer
from crossgrad_core.registry.entries import load

class Gains(Metric):
    figure = Figure("gains", "gains")

    def measure(self, compared):
        return 1.0

class Listens(Observer):
    pass

""" + "\n".join(
    f"class Own{slot.title()}(load({slot!r}, {name!r})):\n    pass\n"
    for slot, name in TRAINS.items()
)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """The folder of a run, whose package is gone again."""
    plugins = {slot: {f"own-{slot}": f"made_up_gone:Own{slot.title()}"} for slot in TRAINS}
    plugins |= {"metrics": {"gains": "made_up_gone:Gains"}}
    plugins |= {"observers": {"listens": "made_up_gone:Listens"}}
    write_distribution(tmp_path / "site", "gone", plugins, {"made_up_gone": SOURCE})
    scene, out = write_tiny_scene(tmp_path / "tiny", views=9), tmp_path / "run"
    given = ["--steps", "4", "--views", "2", "--threads", "1", "-q", "--out", out]
    for option in ("sampler", "operator", "densifier", "loss", "initializer", "resolution"):
        slot = "losses" if option == "loss" else f"{option}s"
        given += [f"--{option}", f"own-{slot}"]
    with monkeypatch.context() as patched:
        patched.syspath_prepend(tmp_path / "site")
        sys.modules.pop("made_up_gone", None)
        assert ended("run", scene, *given, "--metrics", "gains", "--observe", "listens") == 0
    return out


def test_a_run_can_be_evaluated_without_the_plugins_that_trained_it(run, capsys):
    before = (run / "per_view.csv").read_text()
    assert ended("eval", run) == 0
    told = capsys.readouterr().err
    assert (
        "components that are not installed here are not used: sampler own-samplers, "
        "operator own-operators" in told
    )
    assert "metrics gains, observers listens" in told
    assert (run / "per_view.csv").read_text() == before
    assert ended("export", run, "--out", run.parent / "again.ply") == 0
    assert (run.parent / "again.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()
    assert ended("render", run, "--out", run.parent / "pictures") == 0


def test_a_run_cannot_be_resumed_without_its_plugins(run, capsys):
    assert ended("run", "--resume", run, "-q") == 2
    assert "own-" in capsys.readouterr().err


def test_changed_settings_are_refused_even_without_the_plugins(run, capsys):
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("own-losses", "other-losses"))
    assert ended("eval", run) == 2
    assert (
        "settings in config.yaml have changed since the run was started" in capsys.readouterr().err
    )


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("dilation: 0.3", "dilation: 1.5", "rasterizer.dilation"),
        ("max_alpha: 0.99", "max_alpha: 0.5", "rasterizer.max_alpha"),
        ("near: ", "near: 1", "rasterizer.near"),
        ("revisions: []", "revisions: [[1, 2]]", "revisions"),
        ("planned_seconds: null", "planned_seconds: 5.0", "time budget"),
    ],
)
def test_changed_render_and_length_settings_are_refused_without_the_plugins(
    run, capsys, old, new, named
):
    text = (run / "config.yaml").read_text()
    assert text.count(old) == 1
    (run / "config.yaml").write_text(text.replace(old, new))
    before = (run / "per_view.csv").read_text()
    assert ended("eval", run) == 2
    told = capsys.readouterr().err
    assert "settings in config.yaml have changed since the run was started" in told
    assert f"settings {named}; step" in told
    assert (run / "per_view.csv").read_text() == before


def test_a_metric_that_cannot_be_measured_keeps_its_value_in_the_file(run, capsys):
    lines = (run / "per_view.csv").read_text().splitlines()
    at = lines[0].split(",").index("lpips")
    cells = [line.split(",") for line in lines[1:]]
    text = (
        "\n".join([lines[0], *(",".join([*c[:at], "0.1234", *c[at + 1 :]]) for c in cells)]) + "\n"
    )
    (run / "per_view.csv").write_text(text)
    assert ended("eval", run) == 0
    assert (run / "per_view.csv").read_text() == text
    assert (
        "per_view.csv was not changed: "
        "it contains metrics that were not computed here (gains, lpips)" in capsys.readouterr().err
    )


def test_a_default_replaces_an_operator_that_names_a_missing_operator():
    operator = {"name": "dispatch", "rules": {"near-far": "own-operators"}}
    config = RunConfig.model_validate({"operator": operator})
    assert [each.name for each in without_missing(config).operators] == ["sum"]
    start = RunConfig.model_validate({"initializer": {"name": "own-starts"}})
    # It has to do without points, which the scene may lack.
    assert load("initializers", without_missing(start).initializer.name).alone
    known = RunConfig.model_validate({"operator": {"name": "cagrad"}})
    assert without_missing(known) == known
