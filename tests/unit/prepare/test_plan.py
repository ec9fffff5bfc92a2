"""What a second start has to agree with: the same photos and masks, wherever they lie."""

import json

import pytest

from crossgrad_core.errors import UserError
from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.plan import Photo, Plan, Settings, agreed, read_plan


def photo(name, content="a", mask=None):
    return Photo(
        name=name, folder="", width=90, height=70, orientation=1, camera="a", position=None,
        mask=mask and f"/masks/{name}.png", mask_sha256=mask, brightness=100.0, sharpness=300.0,
        bytes=1, sha256=content,
    )  # fmt: skip


def plan(*photos, root="/photos", **settings):
    return Plan(photos=root, settings=Settings(**settings), used=photos, left_out=())


@pytest.fixture
def layout(tmp_path):
    return Layout(tmp_path / "scene")


def finish(layout):
    """Makes the scene look ready."""
    layout.images.mkdir(parents=True)
    layout.model.mkdir(parents=True)
    layout.report.write_text("{}")


BEGUN = (photo("a"), photo("b", mask="m"), photo("c"))


def test_preparation_continues_with_the_same_photos_in_another_folder(layout):
    """The same applies to masks. A relative mask folder is another folder there."""
    agreed(layout, plan(*BEGUN, masks="sky"))
    moved = [each.model_copy(update={"mask": each.mask and "/new/b.png"}) for each in BEGUN]
    found = agreed(layout, plan(*moved, root="/new", masks="/new/sky"))
    assert (found.photos, found.used[1].mask) == ("/new", "/new/b.png")
    assert read_plan(layout) == found


@pytest.mark.parametrize(
    ("photos", "settings", "told"),
    [
        (BEGUN[:2], {}, "1 photo gone: c"),
        ((*BEGUN, photo("d"), photo("e")), {}, "2 photos new: d, e"),
        ((photo("a", "x"), *BEGUN[1:]), {}, "1 photo changed: a"),
        ((BEGUN[0], photo("b", mask="n"), BEGUN[2]), {}, "1 mask changed: b"),
        ((BEGUN[0], photo("b"), BEGUN[2]), {}, "1 mask gone: b"),
        ((photo("a", mask="m"), *BEGUN[1:]), {}, "1 mask new: a"),
        (
            (*BEGUN[:2], photo("d")),
            {"max_size": 200},
            "max_size was None, now 200; 1 photo new: d; 1 photo gone: c",
        ),
    ],
)
def test_differences_from_the_first_plan_are_reported_with_a_remedy(photos, settings, told, layout):
    first = agreed(layout, plan(*BEGUN))
    with pytest.raises(UserError, match="begun with other photos or settings") as caught:
        agreed(layout, plan(*photos, **settings))
    assert caught.value.found == told
    assert "use the original photos and settings" in caught.value.todo
    assert read_plan(layout) == first


def test_a_finished_scene_needs_no_photos_and_refuses_new_photos(layout):
    first = agreed(layout, plan(*BEGUN))
    finish(layout)
    assert agreed(layout, plan(BEGUN[0], photo("b"), root="/new")) == first
    for other in (photo("d"), photo("a", "x"), photo("b", mask="n"), photo("c", mask="m")):
        with pytest.raises(UserError, match="begun with other photos or settings"):
            agreed(layout, plan(other))
    assert read_plan(layout) == first


def test_plans_without_checksums_of_masks_can_be_continued(layout):
    agreed(layout, plan(*BEGUN))
    content = json.loads(layout.plan.read_text())
    for each in content["used"]:
        del each["mask_sha256"], each["transparent"]
    layout.plan.write_text(json.dumps(content))
    assert agreed(layout, plan(*BEGUN)).used == BEGUN
    with pytest.raises(UserError, match="begun with other photos or settings"):
        agreed(layout, plan(BEGUN[0], photo("b"), BEGUN[2]))
