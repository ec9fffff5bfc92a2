import pytest

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.split import split_views

NAMES = [f"{k:02d}.jpg" for k in range(28)]


def split(names, root, given=None, **options):
    return split_views(names, SceneOptions(**options), root, given)


def test_every_eighth_photo_by_name_is_held_out(tmp_path):
    result = split(NAMES[::-1], tmp_path)
    assert result.test == ("00.jpg", "08.jpg", "16.jpg", "24.jpg")
    assert len(result.train) == 24
    assert "24 train, 4 test" in result.notes[0]


def test_photo_folders_are_split_separately(tmp_path):
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
def test_a_split_of_few_views_leaves_at_least_one_training_view(names, test, tmp_path):
    result = split(names, tmp_path)
    assert result.test == test
    assert result.train
    assert sorted(result.train + result.test) == sorted(names)


def by_parity(_train):
    """Two regimes that take turns: each eighth of all is always of the even one."""
    return {name: ("even", "odd")[k % 2] for k, name in enumerate(NAMES)}


def test_the_stratified_split_holds_out_every_eighth_photo_of_each_regime(tmp_path):
    result = split_views(NAMES, SceneOptions(split="stratified"), tmp_path, label=by_parity)
    assert result.test == ("00.jpg", "01.jpg", "16.jpg", "17.jpg")
    assert len(result.train) == 24 and result.regimes == by_parity(())
    assert result.notes == ("split: 24 train, 4 test (1 in 8 by name in each regime)",)
    fourth = SceneOptions(split="stratified", test_every=4)
    assert len(split_views(NAMES, fourth, tmp_path, label=by_parity).test) == 8


def test_the_default_split_is_stratified_only_if_a_regime_needs_it(tmp_path):
    result = split_views(NAMES, SceneOptions(), tmp_path, label=by_parity)
    assert result.test == ("00.jpg", "01.jpg", "16.jpg", "17.jpg")
    assert result.notes[1] == (
        "split: by regime, since 1 in 8 by name would hold out 0 photos of odd"
    )
    assert split_views(NAMES, SceneOptions(split="every"), tmp_path, label=by_parity).test == (
        ("00.jpg", "08.jpg", "16.jpg", "24.jpg")
    )


def test_regimes_with_two_held_out_views_keep_the_plain_split(tmp_path):
    def halves(_train):
        return {name: "first" if name < "14.jpg" else "last" for name in NAMES}

    result = split_views(NAMES, SceneOptions(), tmp_path, label=halves)
    assert (result.test, result.regimes) == (("00.jpg", "08.jpg", "16.jpg", "24.jpg"), None)


def test_regimes_too_small_for_two_held_out_views_keep_the_plain_split(tmp_path):
    def few(_train):
        return {name: "few" if k in range(20, 28) else "many" for k, name in enumerate(NAMES)}

    # Eight photos of a regime give one held-out photo either way.
    assert split_views(NAMES, SceneOptions(), tmp_path, label=few).regimes is None
    half = SceneOptions(test_every=100)
    assert split_views(NAMES, half, tmp_path, label=by_parity).regimes is None


def test_the_regimes_of_each_candidate_split_use_its_training_views(tmp_path):
    asked = []

    def label(train):
        asked.append(len(train))
        return dict.fromkeys(NAMES, "all")

    split_views(NAMES, SceneOptions(), tmp_path, label=label)
    assert sorted(set(asked)) == [24, 28]


def test_splits_by_lists_or_by_every_nth_photo_need_no_regimes(tmp_path):
    def label(_train):
        raise AssertionError

    for way in ("every", "none"):
        split_views(NAMES, SceneOptions(split=way), tmp_path, label=label)
    (tmp_path / "test_list.txt").write_text("05.jpg\n")
    assert split_views(NAMES, SceneOptions(), tmp_path, label=label).test == ("05.jpg",)


def test_split_none_trains_on_all_views(tmp_path):
    assert split(NAMES, tmp_path, split="none").train == tuple(NAMES)


def test_view_lists_define_the_split_unless_a_method_is_given(tmp_path):
    (tmp_path / "train_list.txt").write_text("# mine\n./03.jpg\r\n04.jpg\n\n99.jpg\n")
    (tmp_path / "test_list.txt").write_text("05.jpg\n")
    result = split(NAMES, tmp_path)
    assert (result.train, result.test) == (("03.jpg", "04.jpg"), ("05.jpg",))
    notes = "\n".join(result.notes)
    assert "1 listed names have no photo with a pose: 99.jpg" in notes
    assert "25 views left out (in no list): 00.jpg, 01.jpg, 02.jpg and 22 more" in notes
    assert len(split(NAMES, tmp_path, split="every").test) == 4


def test_with_a_single_list_all_other_views_form_the_other_set(tmp_path):
    (tmp_path / "test_list.txt").write_text("05.jpg\n")
    assert len(split(NAMES, tmp_path).train) == 27
    (tmp_path / "test_list.txt").rename(tmp_path / "train_list.txt")
    result = split(NAMES, tmp_path)
    assert result.train == ("05.jpg",)
    assert len(result.test) == 27


def test_a_split_given_by_the_input_is_kept(tmp_path):
    given = (frozenset({"00.jpg"}), frozenset({"01.jpg"}))
    assert split(NAMES, tmp_path, given=given).test == ("01.jpg",)
    # Lists of the user come first.
    (tmp_path / "test_list.txt").write_text("02.jpg\n")
    assert split(NAMES, tmp_path, given=given).test == ("02.jpg",)


def test_names_in_both_split_lists_are_refused(tmp_path):
    for name in ("train_list.txt", "test_list.txt"):
        (tmp_path / name).write_text("05.jpg\n")
    with pytest.raises(UserError, match=r"for both training and testing(?s:.*)05\.jpg"):
        split(NAMES, tmp_path)


@pytest.mark.parametrize("text", ["", "5.jpg\n"])
def test_split_lists_without_a_training_view_are_refused(text, tmp_path):
    (tmp_path / "train_list.txt").write_text(text)
    with pytest.raises(UserError, match="no listed view can be used for training"):
        split(NAMES, tmp_path)
