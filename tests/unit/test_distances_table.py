"""`benchmarks/distances.py`: figures on views elsewhere in bands of distance, near ones first."""

import csv

import pytest
from support.run_folders import RunFolder
from support.scenes import write_tiny_scene
from support.scripts import printed_by

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


def test_near_views_come_first_and_arms_are_compared_band_by_band(tmp_path, place, printed):
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
    assert all(title.endswith("(2)") for title in titles)
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


def test_a_scene_or_an_arm_that_is_not_there_is_named(tmp_path, place, printed, capsys):
    write_run(tmp_path / "runs/a", place, 300, 0, {"street": 20.0, "aerial": 25.0})
    for options, said in (
        (("--of", "city", "--baseline", "other"), "no arm other"),
        (("--of", "beach"), "there are none"),
    ):
        with pytest.raises(SystemExit):
            printed(tmp_path / "runs", "--on", place, *options)
        assert said in capsys.readouterr().err
