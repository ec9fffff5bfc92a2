"""A regime without held-out photos is named, with the option that changes it."""

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.commands import configured, read_scene

FOLDERS = ("street", "aerial")


def notes_of(path, **reading):
    scene, _ = read_scene(configured({"scene": str(path), "data": reading}))
    return [note for note in scene.notes if "is held out" in note]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two regimes, whose lists hold out photos of one alone."""
    folder = write_tiny_scene(tmp_path_factory.mktemp("scene"), views=8, folders=FOLDERS)
    names = [f"{each}/{number:04}.png" for each in FOLDERS for number in range(8)]
    held_out = {"street/0000.png", "street/0004.png"}
    (folder / "test_list.txt").write_text("\n".join(sorted(held_out)))
    (folder / "train_list.txt").write_text("\n".join(set(names) - held_out))
    return folder


def test_a_regime_without_held_out_photos_is_named_with_the_option(scene):
    (note,) = notes_of(scene)
    assert "no photo of aerial is held out" in note
    assert "--split stratified" in note


@pytest.mark.parametrize("split", ["stratified", "every", "none"])
def test_other_splits_give_no_note_about_regimes(scene, split):
    assert notes_of(scene, split=split) == []


def test_plan_also_names_a_regime_without_held_out_photos(scene, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert ended("plan", scene) == 0
    (row,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("held out")]
    assert "the quality of aerial" in row
    assert "--split stratified" in row
