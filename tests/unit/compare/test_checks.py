"""Runs that cannot be compared are refused with the reason and a remedy."""

import json
from html import unescape
from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare import app
from crossgrad_plugins.compare.app import differing_code
from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.quantity import ClockChoice

LOADED = {"load": {"mean": 5.0, "max": 9.0}}


def comparison(folder: Path, *runs: RunFolder, **options):
    for number, run in enumerate(runs):
        run.write(folder / f"run-{number}")
    return compared(read_runs([folder], skip_broken=False), Options(**options))


def costs(found):
    return [cost.name for cost in found.costs]


@pytest.mark.parametrize(
    ("other", "what", "found"),
    [
        ({"held_out": ("a/1.jpg", "a/2.jpg", "b/1.jpg", "c/9.jpg")}, "held-out views", "c/9.jpg"),
        ({"photos": "photos: 800 x 600 px (16) from images/, not resized"}, "sizes", "800 x 600"),
        (
            {"photos": "photos: 400 x 300 px (16) from images/, 16 resized (box)"},
            "resize filters",
            "16 resized (box)",
        ),
        ({"definitions": {"psnr": "of means"}}, "define psnr differently", "of means"),
        ({"definitions": {"renders": "not rounded"}}, "different rules", "not rounded"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_runs_that_cannot_be_compared_are_refused(tmp_path, other, what, found):
    with pytest.raises(UserError, match=what) as error:
        comparison(tmp_path, RunFolder(), RunFolder(views_per_step=2, **other))
    assert found in error.value.found
    assert "run-0" in error.value.where
    assert "run-1" in error.value.where
    assert error.value.todo


def test_two_scenes_with_the_same_name_are_refused(tmp_path):
    first, second = RunFolder().write(tmp_path / "1"), RunFolder(seed=1).write(tmp_path / "2")
    scene = (first / "scene.json").read_text().replace('"sha256": "city"', '"sha256": "other"')
    (second / "scene.json").write_text(scene)
    with pytest.raises(UserError, match="different photos"):
        compared(read_runs([tmp_path], skip_broken=False), Options())


@pytest.mark.parametrize("content", ['{"format": 1, "views": {"a/1.j', "{}", "[]", '{"views": 1}'])
def test_a_run_with_a_damaged_scene_file_is_refused_or_left_out(tmp_path, content):
    """Without the scene file, a difference between the photos of two runs would not be found."""
    RunFolder().write(tmp_path / "1")
    other = RunFolder(views_per_step=2).write(tmp_path / "2")
    (other / "scene.json").write_text(content)
    with pytest.raises(UserError, match=r"scene.json cannot be read(.|\n)*--skip-broken"):
        read_runs([tmp_path], skip_broken=False)
    found = read_runs([tmp_path], skip_broken=True)
    assert len(found.runs) == 1 and list(found.left_out) == ["2"]


def test_a_missing_scene_file_is_reported(tmp_path):
    for number in (1, 2):
        folder = RunFolder(views_per_step=number).write(tmp_path / str(number))
    assert not any("scene.json" in note for note in comparison(tmp_path).notes)
    (folder / "scene.json").unlink()
    (told,) = (note for note in comparison(tmp_path).notes if "scene.json" in note)
    assert told.startswith("1 without") and told.endswith("their photos are not known: 2")


@pytest.mark.parametrize("rows", [0, 1])
def test_a_finished_run_with_incomplete_metrics_is_refused(tmp_path, rows):
    folder = RunFolder().write(tmp_path / "1")
    lines = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    (folder / "metrics.csv").write_text("".join(lines[:1])[: None if rows else 20])
    with pytest.raises(UserError, match=r"ends before the last step"):
        read_runs([tmp_path], skip_broken=False)


def test_another_training_split_is_refused(tmp_path):
    first, second = RunFolder().write(tmp_path / "1"), RunFolder(seed=1).write(tmp_path / "2")
    scene = (first / "scene.json").read_text().replace('"trained": true', '"trained": false', 1)
    (second / "scene.json").write_text(scene)
    with pytest.raises(UserError, match="trained on different photos"):
        compared(read_runs([tmp_path], skip_broken=False), Options())


def test_the_record_of_a_run_says_for_which_metrics_less_is_better(tmp_path):
    for name, views, error in (("worse", 1, 9.0), ("better", 2, 4.0)):
        path = RunFolder(views_per_step=views).write(tmp_path / name) / "summary.json"
        summary = json.loads(path.read_text()) | {"falling": ["mae"]}
        summary["overall"] |= {"mae": error}
        path.write_text(json.dumps(summary))
    found = compared(read_runs([tmp_path], skip_broken=False), Options(metric="mae"))
    assert found.ranking == ("views=2", "views=1")
    assert [each.favours for each in found.ends] == ["views=2"]


def test_runs_without_held_out_photos_are_refused_with_this_reason(tmp_path):
    path = RunFolder().write(tmp_path / "run") / "summary.json"
    summary = json.loads(path.read_text())
    summary["overall"] = {"views": 0, "psnr": None, "ssim": None}
    path.write_text(json.dumps(summary))
    with pytest.raises(UserError, match="no run held out a photo"):
        compared(read_runs([tmp_path], skip_broken=False), Options())


def test_metrics_with_different_definitions_are_left_out_with_a_note(tmp_path):
    found = comparison(tmp_path, RunFolder(), RunFolder(seed=1, definitions={"ssim": "other"}))
    assert [quantity.name for quantity in found.quantities] == ["psnr"]
    assert any("ssim is not compared" in note for note in found.notes)


@pytest.mark.parametrize(
    "environment",
    [
        {"cpu": "Another Processor"},
        {"cpu_cores": 64},
        {"torch_threads": 2},
        {"gpu": "A GPU"},
        LOADED,
        {"calibration": {"rate": 2.0}},
    ],
    ids=str,
)
def test_wall_seconds_of_different_machines_are_not_drawn(tmp_path, environment):
    usual = {"calibration": {"rate": 1.0}} if "calibration" in environment else {}
    runs = RunFolder(environment=usual), RunFolder(seed=1, environment=environment)
    found = comparison(tmp_path, *runs)
    assert costs(found) == ["views", "steps"]
    assert any("wall-clock seconds are not compared" in note for note in found.notes)
    with pytest.raises(UserError, match="seconds of these runs cannot be compared") as error:
        compared(read_runs([tmp_path], skip_broken=False), Options(clock=ClockChoice.WALL))
    assert "leave --clock out" in error.value.todo


def test_runs_on_a_busy_machine_are_compared_by_cpu_seconds_only(tmp_path):
    runs = [RunFolder(seed=n, cpu_seconds=50.0, environment=LOADED) for n in range(2)]
    assert costs(comparison(tmp_path, *runs)) == ["cpu_seconds", "views", "steps"]
    with pytest.raises(UserError, match="--clock cpu"):
        compared(read_runs([tmp_path], skip_broken=False), Options(clock=ClockChoice.WALL))


@pytest.mark.parametrize(
    ("clock", "expected"),
    [("auto", ["seconds", "cpu_seconds"]), ("wall", ["seconds"]), ("cpu", ["cpu_seconds"]),
     ("none", [])],
)  # fmt: skip
def test_the_user_can_choose_the_clock(tmp_path, clock, expected):
    runs = [RunFolder(seed=n, cpu_seconds=50.0) for n in range(2)]
    found = comparison(tmp_path, *runs, clock=ClockChoice(clock))
    assert costs(found) == [*expected, "views", "steps"]


def test_cpu_seconds_of_several_threads_are_not_compared(tmp_path):
    many = {"torch_threads": 2}
    runs = [RunFolder(seed=n, cpu_seconds=50.0, environment=many) for n in range(2)]
    assert costs(comparison(tmp_path, *runs)) == ["seconds", "views", "steps"]


@pytest.mark.parametrize(("rate", "left"), [(1.2, ["cpu_seconds"]), (1.4, [])])
def test_cpu_seconds_are_compared_between_machines_of_similar_speed(tmp_path, rate, left):
    runs = [
        RunFolder(
            seed=seed,
            cpu_seconds=50.0,
            environment={"calibration": {"rate": own, "cpu_rate": own}},
        )
        for seed, own in enumerate((1.0, rate))
    ]
    assert costs(comparison(tmp_path, *runs)) == [*left, "views", "steps"]


def test_runs_without_cpu_seconds_get_no_axis_of_cpu_seconds_and_no_note(tmp_path):
    found = comparison(tmp_path, RunFolder(), RunFolder(seed=1))
    assert costs(found) == ["seconds", "views", "steps"]
    assert found.notes == ()


def test_runs_with_different_regimes_are_compared_overall_only(tmp_path):
    other = RunFolder(views_per_step=2, regimes={"street": 1.0, "air": -1.0})
    found = comparison(tmp_path, RunFolder(), other)
    assert [each.where for each in found.ends] == ["at the end"]
    assert found.regimes == ()
    assert any("regimes of scene city are not compared" in note for note in found.notes)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"metric": "lpips"}, "no run has this metric"),
        ({"baseline": "x"}, "names an arm that does not exist"),
    ],
)
def test_unknown_names_of_metrics_and_arms_are_refused(tmp_path, options, match):
    with pytest.raises(UserError, match=match) as error:
        comparison(tmp_path, RunFolder(), RunFolder(views_per_step=2), **options)
    assert "psnr" in error.value.expected or "views=1" in error.value.expected


def test_errors_about_metrics_give_advice_that_works(tmp_path):
    with pytest.raises(UserError, match="no run has this metric") as lacking:
        comparison(tmp_path / "1", RunFolder(), metric="lpips")
    other = RunFolder(views_per_step=2, definitions={"psnr": "of means"})
    with pytest.raises(UserError, match="define psnr differently") as unlike:
        comparison(tmp_path / "2", RunFolder(), other)
    assert "crossgrad run --metrics NAME" in lacking.value.todo
    # `crossgrad eval` measures what a run measures, and writes elsewhere.
    assert not any("crossgrad eval" in each.value.todo for each in (lacking, unlike))


def made_with(views, seed, commit, **more):
    return RunFolder(views_per_step=views, seed=seed, environment={"commit": commit}, **more)


@pytest.mark.parametrize(
    ("commits", "expected"),
    [
        # Of one view with seeds 0 and 1, then of two views.
        ("aaaa", None),
        ("abab", None),
        ("aabb", "code differs: 'views=1' ran at commit a; 'views=2' ran at commit b: "),
        (
            "aaab",
            "code differs: 'views=1' ran at commit a; 'views=2' ran at commit a and commit b: ",
        ),
        ("abba", "code differs within pairs: run-0 ran at commit a, run-2 ran at commit b: "),
        (("a", "a", None, None), "'views=2' ran at crossgrad 0.2.0: "),
    ],
)
def test_arms_and_pairs_trained_with_different_code_get_a_note(tmp_path, commits, expected):
    arms = [(views, seed) for views in (1, 2) for seed in (0, 1)]
    runs = [made_with(*arm, commit) for arm, commit in zip(arms, commits, strict=True)]
    notes = differing_code(comparison(tmp_path, *runs).main)
    if expected is None:
        assert notes == []
    else:
        (note,) = notes
        assert expected in note
        assert note.endswith("their speed may differ, and so may their bits")


def test_runs_of_unknown_code_version_get_no_note(tmp_path):
    unknown = {"commit": None, "crossgrad": None}
    runs = RunFolder(environment=unknown), made_with(2, 0, "a")
    assert differing_code(comparison(tmp_path, *runs).main) == []


def test_a_note_about_many_arms_names_only_three(tmp_path):
    runs = [made_with(views, 0, f"c{views}") for views in range(1, 7)]
    (note,) = differing_code(comparison(tmp_path, *runs).main)
    assert "'views=3' ran at commit c3; 3 more: " in note
    runs = [made_with(views, 1, "a" if views == 1 else "b") for views in range(1, 7)]
    (note,) = differing_code(comparison(tmp_path / "again", *runs).main)
    assert "'views=2', 'views=3', 'views=4' and 2 more ran at commit b: " in note


def test_compare_prints_the_note_about_different_code(tmp_path, monkeypatch, capsys):
    for views, commit in ((1, "aaaaaaa"), (2, "bbbbbbb")):
        made_with(views, 0, commit).write(tmp_path / "runs" / f"{views}")
    monkeypatch.setattr(app, "drawn_figures", lambda _: [])
    app.compare([tmp_path / "runs"], Options(), tmp_path / "out", skip_broken=False)
    note = "'views=1' ran at commit aaaaaaa; 'views=2' ran at commit bbbbbbb: "
    assert f"note: code differs: {note}" in capsys.readouterr().out
    assert note in unescape((tmp_path / "out" / "index.html").read_text())
