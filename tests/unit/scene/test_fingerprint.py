"""A scene is known again, and how it has changed is said in words and weighed."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from support.scenes import write_tiny_scene

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.run.assemble import read_scene
from crossgrad_core.run.results.scene_file import FILE, check_scene, read_scene_file, write_scene
from crossgrad_core.scene.fingerprint import (
    END,
    FileMark,
    Weight,
    differences,
    fingerprint_of,
    mark_of,
)
from crossgrad_core.testing.fixtures import sample_scene


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_tiny_scene(folder, views=10)
    (folder / "masks").mkdir()
    Image.new("L", (48, 32), 255).save(folder / "masks" / "0003.png")
    return folder


@pytest.fixture
def scene(pristine, tmp_path):
    return Path(shutil.copytree(pristine, tmp_path / "scene"))


def taken(folder: Path, **reading: object):
    config = RunConfig.model_validate({"data": reading})
    return fingerprint_of(read_scene(config, folder)[0], folder)


def told(folder: Path, was) -> list[tuple[Weight, str]]:
    return [(each.weight, each.text) for each in differences(was, taken(folder))]


def test_a_copied_scene_with_new_time_stamps_is_recognised(pristine, scene):
    for path in scene.rglob("*.*"):
        path.touch()
    assert told(scene, taken(pristine)) == []


def test_a_missing_photo_that_shifts_the_split_is_reported(scene):
    """Every eighth photo by name is held out: first 0000 and 0008, then 0000 and 0009."""
    was = taken(scene)
    (scene / "images" / "0002.png").unlink()
    found = told(scene, was)
    assert {weight for weight, _ in found} == {Weight.PLACE}
    assert [text for _, text in found] == [
        "training photos missing: 1 (0002.png)",
        "photos that were training photos and are now held out: 1 (0009.png)",
        "photos that were held out and are now training photos: 1 (0008.png)",
    ]


def test_a_missing_held_out_photo_of_a_list_is_reported(scene):
    names = [f"{index:04}.png" for index in range(10)]
    (scene / "train_list.txt").write_text("\n".join(names[2:]))
    (scene / "test_list.txt").write_text("\n".join(names[:2]))
    was = taken(scene)
    (scene / "images" / "0001.png").unlink()
    assert told(scene, was) == [(Weight.HELD_OUT, "held-out photos missing: 1 (0001.png)")]
    (scene / "test_list.txt").write_text(names[0])
    assert told(scene, was)[1] == (Weight.HELD_OUT, "test_list.txt changed")


def test_a_list_with_another_layout_but_the_same_views_is_no_difference(scene):
    (scene / "test_list.txt").write_text("0001.png\n0004.png\n")
    was = taken(scene)
    (scene / "test_list.txt").write_text("# held out\n0004.png\n0001.png\n")
    assert told(scene, was) == []


def test_changed_photos_are_reported(scene):
    was = taken(scene)
    for index in range(5):
        path = scene / "images" / f"{index:04}.png"
        with Image.open(path) as image:
            image.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(path)
    text = "photos changed: 5 (0000.png, 0001.png, 0002.png and 2 more)"
    assert told(scene, was) == [(Weight.CONTENT, text)]


@pytest.mark.parametrize("change", ["changed", "new", "missing"])
def test_changed_new_and_missing_masks_are_reported(scene, change):
    was = taken(scene)
    if change == "missing":
        shutil.rmtree(scene / "masks")
    else:
        name = "0003.png" if change == "changed" else "0004.png"
        Image.new("L", (48, 32), 254).save(scene / "masks" / name)
    name = "0004.png" if change == "new" else "0003.png"
    text = f"masks that were changed, added or removed: 1 ({name})"
    assert told(scene, was) == [(Weight.CONTENT, text)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("other", "text"),
    [
        ({"scale": 2.0}, "its unit is 5.46405 input units (before: 2.73202)"),
        ({"offset": (1.0, 0.0, 0.0)}, "its origin moved by 1"),
        ({"width": 24, "height": 16}, "photos with another size, camera or pose: 10 (0000.png"),
        ({"points": 150}, "other SfM points (150; before 200)"),
    ],
)
def test_another_reconstruction_is_reported(pristine, tmp_path, other, text):
    write_tiny_scene(tmp_path / "other", **{"views": 10, **other})
    shutil.copytree(pristine / "masks", tmp_path / "other" / "masks")
    found = told(tmp_path / "other", taken(pristine))
    assert text in " ".join(text for _, text in found)
    heavy = Weight.CONTENT if "points" in other else Weight.PLACE
    assert max(weight for weight, _ in found) is heavy


def test_another_scene_in_the_same_folder_is_reported(pristine, tmp_path):
    write_tiny_scene(tmp_path / "other", views=10, seed=1)
    found = told(tmp_path / "other", taken(pristine))
    assert [text.partition(":")[0] for _, text in found] == [
        "other SfM points (200; before 200)", "photos changed",
        "masks that were changed, added or removed",
    ]  # fmt: skip


def test_rounding_differences_between_machines_are_no_difference():
    scene = sample_scene()
    was = fingerprint_of(scene, Path())
    jitter = np.random.default_rng(0).uniform(-1e-9, 1e-9, scene.points.shape)
    similarity = replace(
        scene.similarity,
        offset=scene.similarity.offset + 1e-9,
        scale=scene.similarity.scale * (1 + 1e-12),
    )
    now = fingerprint_of(
        replace(scene, points=scene.points + jitter, similarity=similarity), Path()
    )
    assert differences(was, now) == []


def test_photos_without_a_file_are_identified_by_their_cameras():
    found = fingerprint_of(sample_scene(), Path())
    assert all(view.photo is None for view in found.views.values())
    assert sum(view.trained for view in found.views.values()) == len(sample_scene().train)


@pytest.mark.parametrize("size", [0, 1, END - 1, END, END + 1, 2 * END, 5 * END])
def test_the_checksum_of_a_file_covers_its_start_and_end(tmp_path, size):
    path = tmp_path / "photo"
    content = bytearray(size)
    path.write_bytes(content)
    marks = [mark_of(path)]
    assert marks[0].bytes == size
    for place in sorted({0, size - 1, min(END, size) - 1, max(0, size - END)} & set(range(size))):
        path.write_bytes(content[:place] + b"x" + content[place + 1 :])
        marks.append(mark_of(path))
    path.write_bytes(content + b"\0")
    marks.append(mark_of(path))
    assert len({mark.sha256 + str(mark.bytes) for mark in marks}) == len(marks)


def test_a_photo_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(UserError, match="cannot be read") as error:
        mark_of(tmp_path / "gone.png")
    assert "gone.png" in str(error.value)


def test_the_fingerprint_file_is_small_and_read_back(pristine, tmp_path):
    was = taken(pristine)
    write_scene(tmp_path, was)
    assert read_scene_file(tmp_path) == was
    lines = (tmp_path / FILE).read_text().splitlines()
    assert sum(".png" in line for line in lines) == 10
    assert max(map(len, lines)) < 450


@pytest.mark.parametrize("content", [None, "", "[]", "{", '{"format": 2}', "\udc80"])
def test_a_run_without_a_readable_fingerprint_is_resumed_with_a_note(tmp_path, caplog, content):
    if content is not None:
        (tmp_path / FILE).write_text(content, errors="surrogateescape")
    now = fingerprint_of(sample_scene(), Path())
    assert check_scene(tmp_path, now, Weight.CONTENT, accept=False) == ()
    assert "it is not known" in caplog.text and str(tmp_path) in caplog.text


VIEW = next(iter(fingerprint_of(sample_scene(), Path()).views.values()))
STATES = st.sampled_from(["absent", "trained", "held out", "trained, changed", "moved"])


def made(states: dict[str, str]):
    base = fingerprint_of(sample_scene(), Path())
    views = {
        name: VIEW.model_copy(
            update={
                "trained": "trained" in state or state == "moved",
                "photo": FileMark(bytes=1, sha256="b" if "changed" in state else "a"),
                "camera": tuple(x + (state == "moved") for x in VIEW.camera),
            }
        )
        for name, state in states.items()
        if state != "absent"
    }
    return base.model_copy(update={"views": views})


@given(st.dictionaries(st.sampled_from("abcdef"), st.tuples(STATES, STATES)))
def test_the_most_severe_difference_decides(changes):
    was = made({name: before for name, (before, _) in changes.items()})
    now = made({name: after for name, (_, after) in changes.items()})
    found = differences(was, now)
    trained = [{name for name, v in of.views.items() if v.trained} for of in (was, now)]
    moved = [pair for pair in changes.values() if "moved" in pair and len({*pair, "absent"}) == 3]
    if trained[0] != trained[1] or moved:
        expected = Weight.PLACE
    elif was.views.keys() != now.views.keys():
        expected = Weight.HELD_OUT
    else:
        expected = Weight.CONTENT if was != now else None
    assert max((each.weight for each in found), default=None) == expected
    assert len({each.text for each in found}) == len(found)


def test_a_changed_bit_in_the_middle_of_a_large_file_is_detected(tmp_path):
    path = tmp_path / "large"
    path.write_bytes(bytes(300_000))
    before = mark_of(path)
    content = bytearray(300_000)
    content[150_000] = 1
    path.write_bytes(content)
    after = mark_of(path)
    assert after.sha256 == before.sha256 and after.differs(before)
    earlier = before.model_copy(update={"whole": None})
    assert not after.differs(earlier)
