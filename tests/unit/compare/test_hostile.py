"""Folders that are damaged, unfinished, or alone."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare import app
from crossgrad_plugins.compare.comparison import compared
from crossgrad_plugins.compare.figures.differences import draw_differences
from crossgrad_plugins.compare.figures.phases import phases_of
from crossgrad_plugins.compare.load_runs import read_runs
from crossgrad_plugins.compare.narrative import headline
from crossgrad_plugins.compare.options import Options
from crossgrad_plugins.compare.targets import ratios


def headlines(folder: Path) -> str:
    found = compared(read_runs([folder], skip_broken=False), Options())
    return " | ".join(f"{each.claim}: {each.support}" for each in headline(found))


@pytest.fixture(name="folder")
def _folder(tmp_path):
    for views in (1, 2):
        for seed in range(3):
            RunFolder(seed=seed, views_per_step=views).write(tmp_path / f"{views}-{seed}")
    return tmp_path


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("metrics.csv", "step,psnr\n1,high\n"),
        ("metrics.csv", "step,psnr\n1\n"),
        ("metrics.csv", "step,psnr\n300,20.0\n"),
        ("summary.json", '{"status": "fin'),
        ("summary.json", "[]"),
        ("per_view.csv", "nothing\n"),
        ("per_view.csv", "name,regime,psnr\na/1.jpg,far\n"),
        ("config.yaml", ""),
        ("config.yaml", "crossgrad: '0.2'\nscene: /scenes/city\nsteps: 600\n"),
        ("config.yaml", "seed: [1\n"),
        ("config.yaml", "seed: one\n"),
        ("config.yaml", "crossgrad: 9.9\n"),
    ],
)
def test_a_damaged_file_is_named_or_its_run_is_left_out(folder, file, content):
    (folder / "1-1" / file).write_text(content)
    with pytest.raises(UserError) as error:
        read_runs([folder], skip_broken=False)
    assert str(folder / "1-1" / file) in error.value.where
    assert "--skip-broken" in error.value.todo
    found = read_runs([folder], skip_broken=True)
    assert len(found.runs) == 5
    assert list(found.left_out) == ["1-1"]
    assert file in found.left_out["1-1"]


def test_a_summary_with_values_of_wrong_type_is_left_out(folder):
    (folder / "1-1" / "summary.json").write_text('{"status": "finished", "overall": 3, "notes": 1}')
    found = read_runs([folder], skip_broken=True)
    assert list(found.left_out) == ["1-1"]


def changed(path: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def set_phase(value):
    return lambda summary: summary["seconds"]["phases"].update(decode=value)


def set_view(value):
    return lambda marks: marks["views"].update({"a/12.jpg": value})


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    ("file", "change"),
    [
        *(("scene.json", set_view(view)) for view in (1, "photo", ["photo"], True, None)),
        ("summary.json", lambda summary: summary["seconds"].update(phases=[0.5])),
        ("summary.json", lambda summary: summary["seconds"].update(phases=float("nan"))),
        *(
            ("summary.json", set_phase(value))
            for value in ([], {}, "1", None, float("nan"), 10**400)
        ),
        ("summary.json", lambda summary: summary.update(views=10**400)),
        ("summary.json", lambda summary: summary["environment"].update(torch_threads=10**400)),
    ],
)
def test_a_damaged_nested_value_is_named_or_its_run_is_left_out(folder, file, change):
    changed(folder / "1-1" / file, change)
    with pytest.raises(UserError) as error:
        read_runs([folder], skip_broken=False)
    assert error.value.where == str(folder / "1-1" / file)
    found = read_runs([folder], skip_broken=True)
    assert list(found.left_out) == ["1-1"]
    assert compared(found, Options()).ends


@pytest.mark.parametrize("file", ["metrics.csv", "per_view.csv"])
def test_a_number_with_400_digits_counts_as_damage(folder, file):
    path = folder / "1-1" / file
    first, second, *lines = path.read_text().splitlines()
    cells = second.split(",")
    cells[2] = "1" + "0" * 399
    path.write_text("\n".join([first, ",".join(cells), *lines, ""]))
    assert file in read_runs([folder], skip_broken=True).left_out["1-1"]


def test_a_target_reached_at_zero_cost_has_a_ratio(tmp_path):
    for views in (1, 2):
        path = RunFolder(views_per_step=views).write(tmp_path / f"{views}") / "metrics.csv"
        first, second, *lines = path.read_text().splitlines()
        cells = ["0"] * 4 + second.split(",")[4:]
        path.write_text("\n".join([first, ",".join(cells), *lines, ""]))
    found = compared(read_runs([tmp_path], skip_broken=False), Options(target=10.0))
    assert ratios(found.reached) == {"views=1": [1.0], "views=2": [1.0]}


def test_a_run_without_phase_times_is_compared(folder):
    changed(folder / "1-1" / "summary.json", lambda summary: summary["seconds"].pop("phases"))
    found = compared(read_runs([folder], skip_broken=False), Options())
    assert len(phases_of(found)) == 2


def test_an_unfinished_run_is_left_out_and_listed(folder):
    (folder / "1-1" / "summary.json").unlink()
    RunFolder(seed=7, status="stopped").write(folder / "stopped")
    RunFolder(seed=8, status="failed").write(folder / "failed")
    found = compared(read_runs([folder], skip_broken=False), Options())
    assert "has not finished" in found.left_out["1-1"]
    assert "stopped" in found.left_out["stopped"]
    assert "failed" in found.left_out["failed"]
    assert len(found.ends[0].pairs) == 2
    assert [len(arm.failed) for arm in found.arms] == [1, 0]


def test_a_comparison_without_finished_runs_is_refused(tmp_path):
    RunFolder(status="stopped").write(tmp_path / "1")
    with pytest.raises(UserError, match="no run has finished"):
        compared(read_runs([tmp_path], skip_broken=False), Options())


@pytest.mark.parametrize("name", ["empty", "missing"])
def test_a_folder_without_runs_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no run to compare"):
        read_runs([tmp_path / name], skip_broken=False)


def test_a_folder_given_twice_counts_once(folder):
    found = read_runs([folder, folder / "1-0", folder / "1-0"], skip_broken=False)
    assert len(found.runs) == 6


def test_a_copy_of_a_run_does_not_count_as_a_second_seed(folder):
    shutil.copytree(folder / "1-0", folder / "copy")
    found = compared(read_runs([folder], skip_broken=False), Options())
    assert found.left_out == {"copy": "repeats 1-0"}
    assert len(found.ends[0].pairs) == 3


def test_a_single_seed_gives_an_inconclusive_verdict_with_the_reason(tmp_path):
    for views in (1, 2):
        RunFolder(views_per_step=views, final=20.0 + views).write(tmp_path / str(views))
    text = headlines(tmp_path)
    assert "Inconclusive: views=2 is 1.00 dB better than views=1" in text
    assert "one pair does not show the noise" in text


def test_a_single_seed_of_three_arms_gives_no_statement_about_noise(tmp_path):
    for views in (1, 2, 3):
        RunFolder(views_per_step=views, final=20.0 + views).write(tmp_path / str(views))
    text = headlines(tmp_path)
    assert "not distinguishable from views=2, views=1" in text
    assert "one pair does not show the noise" in text and "1 pairs" not in text


def test_three_seeds_give_the_number_of_pairs_that_would_suffice(tmp_path):
    for views, offsets in ((1, (0.0, 0.1, -0.1)), (2, (0.1, -0.1, 0.1))):
        for seed, offset in enumerate(offsets):
            RunFolder(seed=seed, views_per_step=views, final=20.0 + offset).write(
                tmp_path / f"{views}-{seed}"
            )
    assert "pairs are needed to detect 0.1 dB" in headlines(tmp_path)


@pytest.mark.slow
def test_a_single_arm_still_gets_a_page(tmp_path, capsys):
    RunFolder().write(tmp_path / "runs" / "only")
    app.compare([tmp_path / "runs"], Options(), None, skip_broken=False)
    page = (tmp_path / "runs" / "compare" / "index.html").read_text()
    assert "There is only one arm, so nothing can be compared" in page
    assert "nothing can be compared" in capsys.readouterr().out


def test_arms_on_different_scenes_are_not_paired(tmp_path):
    RunFolder(scene="city").write(tmp_path / "1")
    RunFolder(scene="park", views_per_step=2).write(tmp_path / "2")
    # No setting varies within a scene, so there is one arm.
    assert "There is only one arm" in headlines(tmp_path)
    RunFolder(scene="city", seed=5, views_per_step=2).write(tmp_path / "3")
    assert "have no scene with the same seed in common" in headlines(tmp_path)


def test_a_metric_that_one_run_did_not_measure_is_not_compared(tmp_path):
    more = RunFolder(views_per_step=2).write(tmp_path / "more")
    changed(more / "summary.json", lambda summary: summary["overall"].update(sharpness=0.3))
    RunFolder().write(tmp_path / "less")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert "sharpness is not compared: less did not measure it" in found.notes
    assert len(found.arms) == 2


def test_missing_per_view_metrics_are_reported(folder):
    (folder / "1-1" / "per_view.csv").unlink()
    with pytest.raises(UserError) as error:
        read_runs([folder], skip_broken=False)
    assert "the file with the metrics of the held-out views is missing" in error.value.what
    assert "crossgrad eval" in error.value.todo
    assert list(read_runs([folder], skip_broken=True).left_out) == ["1-1"]


def test_results_without_a_configuration_are_reported(folder):
    (folder / "1-1" / "config.yaml").unlink()
    with pytest.raises(UserError, match="no config"):
        read_runs([folder], skip_broken=False)
    found = read_runs([folder], skip_broken=True)
    assert len(found.runs) == 5
    assert list(found.left_out.values()) == ["has no config.yaml"]


def test_a_file_given_as_a_folder_of_runs_is_refused(folder):
    grid = folder / "grid.yaml"
    grid.write_text("base: {}")
    with pytest.raises(UserError) as error:
        app.compare([grid], Options(), None, skip_broken=False)
    assert (error.value.what, error.value.found) == ("there is no run to compare", "a file")


@pytest.mark.parametrize("name", ["margin", "target"])
@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_no_point_of_a_figure_is_at_infinity(folder, name, value):
    with pytest.raises(UserError) as error:
        app.compare([folder], Options(**{name: value}), folder / "out", skip_broken=False)
    assert error.value.where == f"--{name}"


def test_an_incomplete_comparison_is_replaced(folder, monkeypatch):
    monkeypatch.setattr(app, "drawn_figures", lambda found: [draw_differences(found)])
    out = folder / "out"
    app.compare([folder], Options(), out, skip_broken=False)
    (out / "index.html").unlink()
    (out / ".index.html.123.tmp").touch()
    app.compare([folder], Options(), out, skip_broken=False)
    (out / "index.html").unlink()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="do not belong to a comparison"):
        app.compare([folder], Options(), out, skip_broken=False)
    assert (out / "notes.txt").read_text() == "mine"


def test_the_reason_for_missing_pairs_is_reported(tmp_path):
    for seed in range(2):
        RunFolder(seed=seed).write(tmp_path / f"good-{seed}")
        RunFolder(seed=seed, views_per_step=2, status="failed").write(tmp_path / f"bad-{seed}")
    assert "No pairs: every run of views=2 failed" in headlines(tmp_path)


def test_arms_without_final_metrics_are_reported_as_such(tmp_path):
    for seed in range(2):
        RunFolder(seed=seed).write(tmp_path / f"good-{seed}")
        RunFolder(seed=seed, views_per_step=2, final=float("nan")).write(tmp_path / f"bad-{seed}")
    assert "no scene and seed has PSNR at the ends of two arms" in headlines(tmp_path)


def test_equal_means_give_no_leader(tmp_path):
    for views in (1, 2):
        RunFolder(views_per_step=views).write(tmp_path / f"{views}")
    assert "Inconclusive: no difference between views=1 and views=2" in headlines(tmp_path)
