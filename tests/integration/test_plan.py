"""`crossgrad plan` and the plan of a run: the table, and runs without what is left out."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.run import decisions
from crossgrad_core.run.app import BUNDLED_SECONDS
from crossgrad_core.system.yaml_values import read_mapping

FEW = ("--steps", 4, "--threads", 1, "--rasterizer", "torch", "-q")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene"), views=8, points=120)


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A scene without points, which the planner has points found for."""
    return write_tiny_scene(tmp_path_factory.mktemp("bare"), views=8, points=0)


def summary(folder):
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


def settings(folder):
    return read_mapping(folder / "config.yaml", "a configuration", "repair it")


@pytest.fixture(scope="module")
def trained(bare, tmp_path_factory):
    """A planned run that stopped half-way and was continued."""
    out = tmp_path_factory.mktemp("runs") / "planned"
    assert ended("run", bare, *FEW, "--stop-after", 2, "--out", out) == 0
    assert ended("run", "--resume", out, "-q") == 0
    return out


def test_plan_prints_a_table_of_at_most_120_columns(scene, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert ended("plan", scene, "--set", "exposure=gain") == 0
    out = capsys.readouterr().out
    assert "gain (yours)" in out
    assert "cost saved" in out
    assert max(map(len, out.splitlines())) <= 120


def test_the_printed_run_command_repeats_the_given_options(scene, tmp_path, capsys):
    file = tmp_path / "my plan.yaml"
    file.write_text("seed: 3\n")
    asked = ("--config", file, "--seconds", 90, "--max-size", 24, "--set", "background=1, 1, 1")
    assert ended("plan", scene, *asked) == 0
    (way,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("run it")]
    command = shlex.split(way.removeprefix("run it: crossgrad run "))
    assert command[0] == str(scene)
    pairs = set(zip(command[1::2], command[2::2], strict=True))
    assert pairs == {(flag, str(each)) for flag, each in zip(asked[::2], asked[1::2], strict=True)}


@pytest.mark.parametrize("length", [(), ("--seconds", 60)])
def test_a_length_chosen_by_the_planner_is_written_to_the_file(scene, tmp_path, length):
    file = tmp_path / "plan.yaml"
    assert ended("plan", scene, *length, "--write", file) == 0
    stored = read_mapping(file, "a configuration", "repair it")
    assert (stored["max_views"], stored.get("steps")) == (1_000, None)
    assert stored.get("seconds") == (60.0 if length else None)
    assert ended("run", "--config", file, "--dry-run", "-q") == 0


def test_a_plan_for_the_bundled_scene_contains_its_default_length(tmp_path, capsys):
    file = tmp_path / "plan.yaml"
    assert ended("plan", "--max-size", 64, "--write", file) == 0
    stored = read_mapping(file, "a configuration", "repair it")
    assert (stored["max_views"], stored["seconds"]) == (2_400, BUNDLED_SECONDS)
    capsys.readouterr()
    assert ended("plan", "--max-size", 64) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "run it: crossgrad run --max-size 64"


def test_json_output_contains_every_measured_number(bare, capsys):
    assert ended("plan", bare, "--json", "--steps", 4) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["settings"] == {"initializer": "triangulated"}
    parts = {each["part"]: each for each in plan["decisions"]}
    assert set(parts["modes"]["figures"]) == {
        *("bimodality", "separability", "separability_of_even", "smaller_share"),
        *("far_over_near", "range", "views"),
    }
    assert all(each["rule"] and each["source"] for each in parts.values())


def test_a_run_from_a_written_plan_equals_a_run_that_plans_itself(bare, tmp_path, trained):
    file, out = tmp_path / "plan.yaml", tmp_path / "run"
    assert ended("plan", bare, "--steps", 4, "--write", file) == 0
    assert ended("run", "--config", file, *FEW[2:], "--out", out) == 0
    assert (out / "point_cloud.ply").read_bytes() == (trained / "point_cloud.ply").read_bytes()


def test_the_summary_reports_the_decisions_about_the_scene(trained):
    row = summary(trained)["decisions"][0]
    assert (row["setting"], row["value"]) == ("initializer", "triangulated")
    assert row["because"] == "the scene has no SfM points"
    assert settings(trained)["decided"]["initializer"] == row["because"]


def test_the_configuration_repeats_the_run_without_the_planner(trained, tmp_path, monkeypatch):
    known, again = settings(trained), tmp_path / "again"
    assert known["initializer"]["name"] == "triangulated"
    monkeypatch.setattr(decisions, "find", None)
    file = trained / "config.yaml"
    assert ended("run", "--config", file, "--set", "stop_after=null", "-q", "--out", again) == 0
    assert (again / "point_cloud.ply").read_bytes() == (trained / "point_cloud.ply").read_bytes()


def test_a_new_length_makes_the_planner_decide_again(trained, tmp_path):
    file, out = trained / "config.yaml", tmp_path / "run"
    assert ended("run", "--config", file, "--steps", 2, "-q", "--out", out) == 0
    assert settings(out)["decided"]["initializer"] == "the scene has no SfM points"


def test_settings_of_the_user_override_the_plan(bare, tmp_path):
    out = tmp_path / "run"
    given = ("--init", "random", "--exposure", "gain")
    assert ended("run", bare, *FEW, *given, "--out", out) == 0
    assert settings(out)["exposure"]["name"] == "gain"
    assert settings(out)["decided"].keys().isdisjoint({"exposure", "data.init"})


def test_the_plan_triangulates_points_for_a_scene_without_points(bare, capsys):
    assert ended("plan", bare) == 0
    assert "triangulated" in capsys.readouterr().out


def test_a_scene_with_a_single_photo_can_be_trained(tmp_path):
    write_tiny_scene(tmp_path / "one", views=1, points=0)
    out = tmp_path / "run"
    assert ended("run", tmp_path / "one", *FEW, "--out", out) == 0
    assert settings(out)["data"]["init"] == "random"


def test_the_probe_option_measures_quantities_that_need_gradients(tmp_path, capsys):
    hybrid = write_tiny_scene(tmp_path / "hybrid", views=8, points=120, folders=("low", "high"))
    torch = ("--set", "rasterizer=torch", "--threads", 1, "--max-size", 24)
    assert ended("plan", hybrid, *torch, "--probe", 1, "--json") == 0
    parts = {each["part"]: each for each in json.loads(capsys.readouterr().out)["decisions"]}
    assert parts["modes"]["decision"] == "two modes"
    pairs = parts["pairs of views"]["figures"]
    assert pairs["rho_low"] <= pairs["rho"] <= pairs["rho_high"]
    assert parts["views per step"]["figures"]["noise_scale"] != 0.0
    assert 0.0 <= parts["operator"]["figures"]["conflict"] <= 1.0


def test_plan_overwrites_no_file_and_bad_input_writes_nothing(scene, tmp_path, capsys):
    file = tmp_path / "plan.yaml"
    assert ended("plan", tmp_path / "nothing", "--write", file) == 2
    assert not file.exists()
    file.write_text("mine")
    assert ended("plan", scene, "--write", file) == 2
    assert file.read_text() == "mine"
    assert "already exists" in capsys.readouterr().err


_LOADED = """
import sys
from crossgrad_core.cli.main import main
try:
    main(sys.argv[1:])
finally:
    print("\\n".join(sorted(name for name in sys.modules if name.startswith("crossgrad_"))))
"""
#: Modules that a run of one mode and even exposure does not need.
LEFT_OUT = (
    *("samplers.balanced", "groupings.distance", "groupings.footprint"),
    *("exposures.gain", "exposures.per_photo", "diagnostics", "planner.probe"),
)


@pytest.mark.slow
def test_unused_components_are_not_imported(scene, tmp_path):
    out = tmp_path / "run"
    arguments = [sys.executable, "-c", _LOADED, "run", scene, *FEW, "--out", out]
    done = subprocess.run(
        list(map(str, arguments)), capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    loaded = done.stdout.splitlines()
    assert "crossgrad_plugins.planner.planner" in loaded
    for name in LEFT_OUT:
        assert f"crossgrad_plugins.{name}" not in loaded


def test_sh_bands_that_the_plan_leaves_out_are_not_allocated(scene, tmp_path, monkeypatch):
    from crossgrad_plugins.planner import view_dependence as measured

    matte = measured.ViewDependence(500, -0.02, -0.03, -0.01)
    monkeypatch.setattr(measured, "view_dependence", lambda scene: matte)
    out = tmp_path / "run"
    assert ended("run", scene, *FEW, "--out", out) == 0
    assert settings(out)["backbone"]["sh_degree"] == 0
    checkpoint = next(Path(out).glob("checkpoints/*"))
    names = b"".join(each.read_bytes()[:4096] for each in checkpoint.glob("*.safetensors"))
    assert b"f_dc" in names
    assert b"f_rest" not in names


@pytest.mark.slow
def test_without_a_plan_the_planner_is_not_imported(scene, tmp_path):
    arguments = [sys.executable, "-c", _LOADED, "run", scene, *FEW, "--plan", "off", "--dry-run"]
    done = subprocess.run(
        list(map(str, arguments)), capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert "crossgrad_plugins.densifiers.adc" in done.stdout
    assert not [name for name in done.stdout.splitlines() if ".planner" in name]
