"""`benchmarks/distances.py`: figures on views elsewhere in bands of distance, near ones first."""

import csv
import json
from types import SimpleNamespace

import pytest
from support.run_folders import RunFolder
from support.scenes import write_tiny_scene
from support.scripts import printed_by

from crossgrad_core.run.postprocess import evaluate

NAMES = [f"{folder}/{number:04}.png" for folder in ("street", "aerial") for number in range(4)]


@pytest.fixture
def printed(monkeypatch, capsys):
    def run(*arguments):
        tables = printed_by("distances.py", arguments, monkeypatch, capsys).rstrip().split("\n\n")
        return [[line.strip("|").split("|") for line in each.splitlines()] for each in tables]

    return run


@pytest.fixture
def place(tmp_path):
    return write_tiny_scene(tmp_path / "place", views=4, folders=("street", "aerial"), scale=7.0)


def write_run(folder, place, steps, seed, figures):
    """A run that has been evaluated there; `figures` by folder."""
    RunFolder(seed=seed, settings={"steps": steps}).write(folder)
    with (folder / f"per_view_on_{place.name}.csv").open("w", newline="") as file:
        lines = csv.writer(file)
        lines.writerow(["name", "regime", "psnr", "ssim"])
        # A run leaves out what it was trained on.
        lines.writerows(
            (n, n[:6], figures[n[:6]], "" if n == NAMES[0] else 0.5)
            for n in NAMES
            if n != "street/0003.png"
        )


def test_near_views_are_listed_first_and_arms_are_compared_per_distance_band(
    tmp_path, place, printed
):
    for seed, more in ((0, 0.0), (1, 0.2), (2, 0.4)):
        base = {"street": 20.0 + more, "aerial": 25.0 + more}
        write_run(tmp_path / f"runs/a{seed}", place, 300, seed, base)
        better = {**base, "street": base["street"] + 1.0}
        write_run(tmp_path / f"runs/b{seed}", place, 600, seed, better)
    means, differences = printed(
        tmp_path / "runs", "--of", "city", "--on", place, "--bands", 2, "--baseline", "300 steps"
    )
    head, _, one, two = means
    titles = [each.strip() for each in head[2:]]
    assert [title.partition(",")[0] for title in titles] == ["aerial"] * 2 + ["street"] * 2
    # Of one of the near bands every run was trained on a view.
    assert [title[-3:] for title in titles[:2]] == ["(2)", "(2)"]
    assert sorted(title[-3:] for title in titles[2:]) == ["(1)", "(2)"]
    low = [float(title.split()[1]) for title in titles]
    # Aerial cameras stand three times as far away, and a pixel of theirs is as much larger.
    assert low[0] <= low[1] and low[2] <= low[3] and low[0] == pytest.approx(3 * low[2], rel=0.3)
    assert [cell.strip() for cell in one] == ["300 steps", "3", *["25.20 ± 0.20"] * 2,
                                              *["20.20 ± 0.20"] * 2]  # fmt: skip
    assert two[4].strip() == "21.20 ± 0.20"
    (others,) = printed(tmp_path / "runs", "--of", "city", "--on", place, "--figure", "ssim")
    assert [cell.strip() for cell in others[2][2:]] == ["0.50 ± 0.00"] * 2
    (row,) = differences[2:]
    assert row[0].strip() == "600 steps"
    assert row[1].strip().startswith("+0.00 [") and "equivalent" in row[1]
    assert row[3].strip().startswith("+1.00 [") and "different (3)" in row[3]


def test_an_unknown_scene_or_arm_is_reported(tmp_path, place, printed, capsys):
    write_run(tmp_path / "runs/a", place, 300, 0, {"street": 20.0, "aerial": 25.0})
    for options, said in (
        (("--of", "city", "--baseline", "other"), "no arm other"),
        (("--of", "beach"), "there are none"),
    ):
        with pytest.raises(SystemExit):
            printed(tmp_path / "runs", "--on", place, *options)
        assert said in capsys.readouterr().err


@pytest.fixture
def evaluated(monkeypatch):
    """Evaluates runs with a stand-in; answers the scenes, and may be told the PSNR."""
    told = SimpleNamespace(psnr=20.0, on=[])

    def measured(folder, on, how):
        told.on.append(on)
        views = [SimpleNamespace(name=n, regime=n[:6], values={"psnr": told.psnr}) for n in NAMES]
        figure = SimpleNamespace(name="psnr")
        return SimpleNamespace(views=views, figures=[figure]), None

    monkeypatch.setattr(evaluate, "evaluated_on", measured)
    monkeypatch.setattr(
        evaluate, "evaluated_file", lambda run, file, how, on: measured(run, on, how)
    )
    return told


def write_evaluable(folder):
    run = RunFolder(settings={"steps": 300}).write(folder)
    (run / "checkpoints" / "step-000300").mkdir(parents=True)
    (run / "point_cloud.ply").write_bytes(b"ply")
    return run


def psnr_of(printed, *options):
    """The mean of the only run in the only band of each folder."""
    (means,) = printed(*options)
    (row,) = means[2:]
    return [cell.strip() for cell in row[2:]]


def test_tables_of_another_scene_with_the_same_name_are_not_used(
    tmp_path, place, printed, evaluated
):
    write_evaluable(tmp_path / "runs" / "a")
    options = tmp_path / "runs", "--of", "city", "--on"
    assert psnr_of(printed, *options, place) == ["20.00"] * 2
    evaluated.psnr = 30.0
    assert psnr_of(printed, *options, place) == ["20.00"] * 2 and len(evaluated.on) == 1
    other = write_tiny_scene(
        tmp_path / "other" / place.name, views=4, folders=("street", "aerial"), scale=3.0
    )
    assert psnr_of(printed, *options, other) == ["30.00"] * 2
    assert evaluated.on == [place, other]


@pytest.mark.parametrize("files", [(), ("--files",)], ids=["model", "ply"])
def test_tables_of_another_step_or_model_file_of_a_run_are_not_used(
    tmp_path, place, printed, evaluated, files
):
    run = write_evaluable(tmp_path / "runs" / "a")
    options = tmp_path / "runs", "--of", "city", "--on", place, *files
    assert psnr_of(printed, *options) == ["20.00"] * 2
    if files:
        (run / "point_cloud.ply").write_bytes(b"other")
    else:
        summary = json.loads((run / "summary.json").read_text())
        (run / "summary.json").write_text(json.dumps({**summary, "step": 700}))
        table = (run / "metrics.csv").read_text()
        (run / "metrics.csv").write_text(table.replace("\n600,", "\n700,"))
    evaluated.psnr = 30.0
    assert psnr_of(printed, *options) == ["30.00"] * 2 and len(evaluated.on) == 2
    # Another command wrote the table: what stands beside it is not of this one.
    table = next(run.glob("per_view*_on_*.csv"))
    table.write_text(table.read_text().replace("30.0", "10.0"))
    assert psnr_of(printed, *options) == ["30.00"] * 2 and len(evaluated.on) == 3


def test_a_stored_table_of_other_views_is_refused(tmp_path, place, printed, capsys):
    write_run(tmp_path / "runs/a", place, 300, 0, {"street": 20.0, "aerial": 25.0})
    assert psnr_of(printed, tmp_path / "runs", "--of", "city", "--on", place)
    other = write_tiny_scene(tmp_path / "other" / place.name, views=4, folders=("elsewhere",))
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path / "runs", "--of", "city", "--on", other)
    assert ended.value.code == 2
    assert "metrics of this run were measured on other views" in capsys.readouterr().err


def test_an_unknown_metric_gives_one_message_before_anything_is_evaluated(
    tmp_path, place, printed, evaluated, capsys
):
    write_evaluable(tmp_path / "runs" / "a")
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path / "runs", "--of", "city", "--on", place, "--figure", "lpips_vgg")
    assert ended.value.code == 2 and not evaluated.on
    said = capsys.readouterr().err
    assert "unknown metric" in said and "one of psnr, ssim" in said
    assert "Traceback" not in said
