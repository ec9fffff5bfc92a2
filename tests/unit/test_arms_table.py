"""`benchmarks/arms.py`: a row for each scene and arm, with what it cost and the code that ran."""

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


def test_means_and_spread_over_seeds(tmp_path, printed):
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


def test_other_figures_can_be_named(tmp_path, printed):
    RunFolder().write(tmp_path / "run")
    (row,) = printed(tmp_path, "--figures", "ssim")
    assert "psnr" not in row and row["ssim"] == "0.7000"


def test_a_folder_without_runs_is_one_message(tmp_path, printed, capsys):
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_differences_from_a_baseline_by_regime(tmp_path, printed):
    for seed in (0, 1, 2):
        RunFolder(seed=seed, final=20.0).write(tmp_path / f"long{seed}")
        settings = {"steps": 300}
        RunFolder(seed=seed, settings=settings, final=20.5).write(tmp_path / f"short{seed}")
    (row,) = printed(tmp_path, "--baseline", "600 steps")
    assert row["arm"] == "300 steps"
    for regime in ("overall", "far", "near"):
        assert row[f"{regime}, less 600 steps"].startswith("+0.50 [+0.50, +0.50], ")


def test_a_baseline_that_is_no_arm_is_refused(tmp_path, printed, capsys):
    RunFolder().write(tmp_path / "run")
    with pytest.raises(SystemExit) as ended:
        printed(tmp_path, "--baseline", "other")
    assert ended.value.code == 2
    assert "no arm other" in capsys.readouterr().err
