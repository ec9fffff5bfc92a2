"""`benchmarks/arms.py`: a row for each scene and arm, with what it cost and the code that ran."""

import shutil

import pytest
from support.run_folders import RunFolder
from support.scripts import printed_by


@pytest.fixture
def printed(monkeypatch, capsys):
    def run(*arguments):
        out = printed_by("arms.py", arguments, monkeypatch, capsys)
        # Of several tables the last one.
        head, rule, *rows = out.rpartition("\n\n")[2].splitlines()
        assert set(rule) == {"|", "-"}
        titles = [cell.strip() for cell in head.strip("|").split("|")]
        cells = ([cell.strip() for cell in row.strip("|").split("|")] for row in rows)
        return [dict(zip(titles, each, strict=True)) for each in cells]

    return run


def test_the_table_shows_means_and_spread_over_seeds(tmp_path, printed):
    for seed, final in ((0, 20.0), (1, 22.0)):
        made_with = {"commit": "abcdef0"}
        run = RunFolder(seed=seed, final=final, environment=made_with, cpu_seconds=50.0 + seed)
        run.write(tmp_path / f"city{seed}")
    RunFolder(scene="beach", settings={"rate_factor": 2}).write(tmp_path / "beach")
    beach, city = printed(tmp_path)
    assert (city["scene"], city["seeds"], city["commit"]) == ("city", "2", "abcdef0")
    assert (city["psnr"], city["far"], city["near"]) == tuple(
        f"{mean:.2f} ± 1.41" for mean in (21.0, 22.5, 19.5)
    )
    assert city["ssim"] == "0.7000 ± 0.0471"
    assert (city["steps"], city["views"], city["Gaussians"]) == ("600", "600", "100,000")
    assert (city["CPU s"], city["rates"], city["PLY, dB"]) == ("50", "by length", "0")
    assert (beach["seeds"], beach["rates"], beach["psnr"]) == ("1", "x 2", "21.00")


def test_each_length_of_an_arm_has_a_row(tmp_path, printed):
    for steps, final in ((300, 20.0), (1200, 22.0)):
        RunFolder(settings={"steps": steps}, final=final).write(tmp_path / f"{steps}")
    rows = printed(tmp_path)
    found = {row["arm"]: (row["seeds"], row["psnr"]) for row in rows}
    assert found == {"300 steps": ("1", "20.00"), "1,200 steps": ("1", "22.00")}


def test_metrics_other_than_psnr_can_be_selected_for_the_table(tmp_path, printed):
    RunFolder().write(tmp_path / "run")
    (row,) = printed(tmp_path, "--figures", "ssim")
    assert "psnr" not in row and row["ssim"] == "0.7000"


def test_a_folder_without_runs_gives_one_message(tmp_path, printed, capsys):
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_differences_from_a_baseline_are_shown_by_regime(tmp_path, printed):
    for seed in (0, 1, 2):
        RunFolder(seed=seed, final=20.0).write(tmp_path / f"long{seed}")
        settings = {"steps": 300}
        RunFolder(seed=seed, settings=settings, final=20.5).write(tmp_path / f"short{seed}")
    (row,) = printed(tmp_path, "--baseline", "600 steps")
    assert row["arm"] == "300 steps"
    for regime in ("overall", "far", "near"):
        assert row[f"{regime}, less 600 steps"].startswith("+0.50 [+0.50, +0.50], ")


def test_a_baseline_that_is_not_an_arm_is_refused(tmp_path, printed, capsys):
    RunFolder().write(tmp_path / "run")
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path, "--baseline", "other")
    assert ended.value.code == 2
    assert "no arm other" in capsys.readouterr().err


def write_sweep(folder, *rows):
    """Runs of two grids in one folder: the learning rates of an arm were changed."""
    for seed in (0, 1):
        for prefix, factor in (("a", 20), ("m", 2)):
            run = RunFolder(seed=seed, settings={"rate_factor": factor}, final=20.0 + factor)
            run.write(folder / "runs" / f"{prefix}{seed}")
    (folder / "runs.csv").write_text("\n".join(["run,scene,configuration,seed", *rows]) + "\n")


def test_runs_of_earlier_grids_are_left_out(tmp_path, printed, capsys):
    new, old = ("a0,city,B,0", "a1,city,B,1"), ("m0,city,B,0", "m1,city,B,1")
    write_sweep(tmp_path, *new, *old)
    (row,) = printed(tmp_path)
    assert (row["arm"], row["seeds"], row["rates"], row["psnr"]) == (
        "B",
        "2",
        "x 20",
        "40.00 ± 0.00",
    )
    (tmp_path / "runs" / "a1" / "summary.json").unlink()
    (row,) = printed(tmp_path)
    assert (row["seeds"], row["rates"]) == ("1", "x 20")


def test_a_renamed_arm_keeps_its_runs(tmp_path, printed):
    new = "a0,city,B,0", "a1,city,B,1", "m0,city,once B,0", "m1,city,once B,1"
    write_sweep(tmp_path, *new, "m0,city,B,0", "m1,city,B,1")
    found = {row["arm"]: (row["seeds"], row["rates"]) for row in printed(tmp_path)}
    assert found == {"B": ("2", "x 20"), "once B": ("2", "x 2")}


def test_two_configurations_of_one_arm_are_refused(tmp_path, printed, capsys):
    write_sweep(tmp_path / "one", "a0,city,B,0", "a1,city,B,1")
    write_sweep(tmp_path / "two", "m0,city,B,0", "m1,city,B,1")
    for folder, names in (("one", "m"), ("two", "a")):
        for seed in (0, 1):
            shutil.rmtree(tmp_path / folder / "runs" / f"{names}{seed}")
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "B has two configurations with seed 0 on city" in said
    assert "one/runs/a0" in said and "two/runs/m0" in said
    assert "rate_factor 20 against 2" in said
