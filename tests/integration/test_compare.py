"""`crossgrad compare` reads what `crossgrad run` writes."""

import csv

from support.commands import ended
from support.pace import each_step_takes
from support.scenes import write_tiny_scene

from crossgrad_core.run import app
from crossgrad_plugins.compare.load_runs import read_runs


def test_compare_reads_the_folders_that_run_writes(tmp_path, capsys):
    scene = write_tiny_scene(tmp_path / "scene", views=9)
    for views in ("1", "2"):
        out = str(tmp_path / "runs" / views)
        options = ["--views", views, "--sampler", "random", "--steps", "4", "--eval-every", "2"]
        assert ended("run", str(scene), *options, "--threads", "1", "--out", out, "-q") == 0
    capsys.readouterr()
    assert ended("compare", str(tmp_path / "runs")) == 0
    printed = capsys.readouterr().out
    assert "views=2  views=1" in printed or "views=1  views=2" in printed
    assert "one pair does not show the noise" in printed

    folder = tmp_path / "runs" / "compare"
    with (folder / "runs.csv").open(newline="") as file:
        rows = {row["arm"]: row for row in csv.DictReader(file)}
    assert {arm: (row["steps"], row["views"]) for arm, row in rows.items()} == {
        "views=1": ("4", "4"),
        "views=2": ("4", "8"),
    }
    assert all(float(row["seconds"]) > 0 and float(row["psnr"]) > 0 for row in rows.values())
    assert all(int(float(row["primitives"])) > 0 for row in rows.values())
    assert all(row["length"] == "4 steps" for row in rows.values())
    # Photo, and render and error of both arms, of each of the two held-out views.
    assert (folder / "index.html").read_text().count("data:image/jpeg;base64,") == 2 * 5
    # Figures of seconds are left out if the machine was busy.
    assert (folder / "figures" / "curves_steps.pdf").is_file()
    assert "views.csv" in {path.name for path in folder.iterdir()}


def test_a_run_with_a_time_budget_keeps_its_length_when_it_is_resumed(tmp_path, monkeypatch):
    scene = write_tiny_scene(tmp_path / "scene", views=9)
    monkeypatch.setattr(app, "steps_for", lambda setup, seconds: (12, "twelve steps", 0.6))
    each_step_takes(monkeypatch, 0.125)
    given = {"scene": str(scene), "out": str(tmp_path / "run"), "threads": 1, "seconds": 1.5}
    assert app.run({**given, "stop_after": 6}, verbosity=-1) == 0
    assert app.run({}, resume=tmp_path / "run", verbosity=-1) == 0
    [run] = read_runs([tmp_path / "run"], skip_broken=False).runs
    assert run.length == ("s", 1.5)
