"""Folders that are damaged, unfinished, old, or alone."""

import shutil
from pathlib import Path

import pytest
from support.run_folders import RunFolder

from crossgrad_core.errors import UserError
from crossgrad_plugins.compare import app
from crossgrad_plugins.compare.comparison import Options, compared
from crossgrad_plugins.compare.source import read_runs
from crossgrad_plugins.compare.words import headline

OLD = Path(__file__).parents[2] / "integration" / "data" / "run-0.1"


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
        ("summary.json", '{"status": "fin'),
        ("summary.json", "[]"),
        ("per_view.csv", "nothing\n"),
        ("config.yaml", "seed: [1\n"),
        ("config.yaml", "seed: one\n"),
        ("config.yaml", "crossgrad: 9.9\n"),
    ],
)
def test_a_damaged_file_is_named_or_its_run_left_out(folder, file, content):
    (folder / "1-1" / file).write_text(content)
    with pytest.raises(UserError) as error:
        read_runs([folder], skip_broken=False)
    assert str(folder / "1-1" / file) in error.value.where
    assert "--skip-broken" in error.value.todo
    found = read_runs([folder], skip_broken=True)
    assert len(found.runs) == 5
    assert list(found.left_out) == ["1-1"]
    assert file in found.left_out["1-1"]


def test_a_damaged_summary_is_found_below_its_surface(folder):
    (folder / "1-1" / "summary.json").write_text('{"status": "finished", "overall": 3, "notes": 1}')
    found = read_runs([folder], skip_broken=True)
    assert list(found.left_out) == ["1-1"]


def test_a_run_without_an_end_is_left_out_and_listed(folder):
    (folder / "1-1" / "summary.json").unlink()
    RunFolder(seed=7, status="stopped").write(folder / "stopped")
    RunFolder(seed=8, status="failed").write(folder / "failed")
    found = compared(read_runs([folder], skip_broken=False), Options())
    assert "has not ended" in found.left_out["1-1"]
    assert "stopped" in found.left_out["stopped"]
    assert "failed" in found.left_out["failed"]
    assert len(found.ends[0].pairs) == 2
    assert [len(arm.failed) for arm in found.arms] == [1, 0]


def test_no_run_has_ended(tmp_path):
    RunFolder(status="stopped").write(tmp_path / "1")
    with pytest.raises(UserError, match="no run has finished"):
        compared(read_runs([tmp_path], skip_broken=False), Options())


@pytest.mark.parametrize("name", ["empty", "missing"])
def test_a_place_without_runs_is_refused(tmp_path, name):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no run to compare"):
        read_runs([tmp_path / name], skip_broken=False)


def test_a_folder_that_is_named_twice_counts_once(folder):
    found = read_runs([folder, folder / "1-0", folder / "1-0"], skip_broken=False)
    assert len(found.runs) == 6


def test_a_copy_of_a_run_is_no_second_seed(folder):
    shutil.copytree(folder / "1-0", folder / "copy")
    found = compared(read_runs([folder], skip_broken=False), Options())
    assert found.left_out == {"copy": "repeats 1-0"}
    assert len(found.ends[0].pairs) == 3


def test_one_seed_is_inconclusive_and_says_so(tmp_path):
    for views in (1, 2):
        RunFolder(views_per_step=views, final=20.0 + views).write(tmp_path / str(views))
    text = headlines(tmp_path)
    assert "Inconclusive: views=2 is 1.00 dB ahead of views=1" in text
    assert "one pair says nothing about noise" in text


def test_one_seed_of_three_arms_says_nothing_about_noise(tmp_path):
    for views in (1, 2, 3):
        RunFolder(views_per_step=views, final=20.0 + views).write(tmp_path / str(views))
    text = headlines(tmp_path)
    assert "not told apart from views=2, views=1" in text
    assert "one pair says nothing about noise" in text and "1 pairs" not in text


def test_three_seeds_say_how_many_would_do(tmp_path):
    for views, offsets in ((1, (0.0, 0.1, -0.1)), (2, (0.1, -0.1, 0.1))):
        for seed, offset in enumerate(offsets):
            RunFolder(seed=seed, views_per_step=views, final=20.0 + offset).write(
                tmp_path / f"{views}-{seed}"
            )
    assert "pairs needed to tell 0.1 dB" in headlines(tmp_path)


def test_one_arm_alone_still_has_a_page(tmp_path, capsys):
    shutil.copytree(OLD, tmp_path / "runs" / "old")
    app.compare([tmp_path / "runs"], Options(), None, skip_broken=False)
    page = (tmp_path / "runs" / "compare" / "index.html").read_text()
    assert "One arm: there is nothing to compare it with" in page
    assert "nothing to compare" in capsys.readouterr().out


def test_arms_on_other_scenes_are_not_paired(tmp_path):
    RunFolder(scene="city").write(tmp_path / "1")
    RunFolder(scene="park", views_per_step=2).write(tmp_path / "2")
    # No setting varies within a scene, so there is one arm.
    assert "One arm" in headlines(tmp_path)
    RunFolder(scene="city", seed=5, views_per_step=2).write(tmp_path / "3")
    assert "share no scene with the same seed" in headlines(tmp_path)


def test_an_old_run_beside_a_new_one(tmp_path):
    shutil.copytree(OLD, tmp_path / "old")
    RunFolder(
        scene="tiny",
        steps=20,
        held_out=("0000.png", "0008.png"),
        regimes={"far": 0.0},
        photos="photos: 32 x 24 px (9) from images/, not resized",
    ).write(tmp_path / "new")
    found = compared(read_runs([tmp_path], skip_broken=False), Options())
    assert "ssim_skimage is not compared: new did not measure it" in found.notes
    assert len(found.arms) == 2
