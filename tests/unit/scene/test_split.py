import pytest

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.split import split_views

NAMES = [f"{k:02d}.jpg" for k in range(28)]


def split(names, root, given=None, **options):
    return split_views(names, SceneOptions(**options), root, given)


def test_every_eighth_by_name_is_held_out(tmp_path):
    result = split(NAMES[::-1], tmp_path)
    assert result.test == ("00.jpg", "08.jpg", "16.jpg", "24.jpg")
    assert len(result.train) == 24
    assert "24 train, 4 test" in result.notes[0]


def test_folders_are_split_each_on_its_own(tmp_path):
    names = [f"street/{k}.jpg" for k in range(5)] + [f"aerial/{k}.jpg" for k in range(3)]
    assert split(names, tmp_path).test == ("aerial/0.jpg", "street/0.jpg")
    assert split(names, tmp_path, test_every=2).test == (
        "aerial/0.jpg",
        "aerial/2.jpg",
        "street/0.jpg",
        "street/2.jpg",
        "street/4.jpg",
    )


@pytest.mark.parametrize(
    ("names", "test"),
    [
        (["a.jpg"], ()),
        (["a.jpg", "b.jpg"], ("a.jpg",)),
        (["x/a.jpg", "y/b.jpg"], ("x/a.jpg",)),
        (["x/a.jpg", "y/b.jpg", "y/c.jpg"], ("y/b.jpg",)),
        (["1/a", "2/a", "3/a", "4/a", "5/a", "6/a", "7/a", "8/a", "9/a"], ("1/a", "9/a")),
    ],
)
def test_few_views_always_leave_one_to_train_on(names, test, tmp_path):
    result = split(names, tmp_path)
    assert result.test == test
    assert result.train
    assert sorted(result.train + result.test) == sorted(names)


def test_none_trains_on_all(tmp_path):
    assert split(NAMES, tmp_path, split="none").train == tuple(NAMES)


def test_lists_win_unless_told_otherwise(tmp_path):
    (tmp_path / "train_list.txt").write_text("# mine\n./03.jpg\r\n04.jpg\n\n99.jpg\n")
    (tmp_path / "test_list.txt").write_text("05.jpg\n")
    result = split(NAMES, tmp_path)
    assert (result.train, result.test) == (("03.jpg", "04.jpg"), ("05.jpg",))
    notes = "\n".join(result.notes)
    assert "1 listed names have no posed photo: 99.jpg" in notes
    assert "25 views in no list left out: 00.jpg, 01.jpg, 02.jpg and 22 more" in notes
    assert len(split(NAMES, tmp_path, split="every").test) == 4


def test_one_list_leaves_the_rest_to_the_other(tmp_path):
    (tmp_path / "test_list.txt").write_text("05.jpg\n")
    assert len(split(NAMES, tmp_path).train) == 27
    (tmp_path / "test_list.txt").rename(tmp_path / "train_list.txt")
    result = split(NAMES, tmp_path)
    assert result.train == ("05.jpg",)
    assert len(result.test) == 27


def test_a_split_of_the_input_itself_is_kept(tmp_path):
    given = (frozenset({"00.jpg"}), frozenset({"01.jpg"}))
    assert split(NAMES, tmp_path, given=given).test == ("01.jpg",)


def test_names_in_both_lists_are_refused(tmp_path):
    for name in ("train_list.txt", "test_list.txt"):
        (tmp_path / name).write_text("05.jpg\n")
    with pytest.raises(UserError, match=r"for training and for testing(?s:.*)05\.jpg"):
        split(NAMES, tmp_path)


@pytest.mark.parametrize("text", ["", "5.jpg\n"])
def test_lists_without_a_training_view_are_refused(text, tmp_path):
    (tmp_path / "train_list.txt").write_text(text)
    with pytest.raises(UserError, match="no listed view can be trained on"):
        split(NAMES, tmp_path)
