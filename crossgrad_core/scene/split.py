"""Which views are trained on and which are held out."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.wording import count, name_some

TRAIN_LIST = "train_list.txt"
TEST_LIST = "test_list.txt"


@dataclass(frozen=True)
class Split:
    """Names of the training and of the held-out views, both sorted, and how they were chosen."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    notes: tuple[str, ...]


def split_views(
    names: Sequence[str],
    options: SceneOptions,
    root: Path,
    given: tuple[frozenset[str], frozenset[str]] | None = None,
) -> Split:
    """Splits views by the option `split`; there is always at least one training view.

    Args:
        names: Names of all usable views.
        options: Says how.
        root: Folder with `train_list.txt` and `test_list.txt`, if any.
        given: Training and test names that the input itself prescribes.

    Raises:
        UserError: The lists contradict each other, match no view or leave no training view.
    """
    if options.split == "none":
        return Split(tuple(sorted(names)), (), (f"split: all {len(names)} views are trained on",))
    if options.split == "auto":
        listed = given or _read_lists(root, names)
        if listed:
            return _split_by_lists(names, listed, root, "by lists" if not given else "as given")
    return _split_every(names, options.test_every)


def _split_every(names: Sequence[str], every: int) -> Split:
    """Each n-th view by name of each folder; folders of a single view are taken together."""
    folders = defaultdict(list)
    for name in sorted(names):
        folders[str(PurePosixPath(name).parent)].append(name)
    groups = [group for group in folders.values() if len(group) > 1]
    groups.append([name for group in folders.values() if len(group) == 1 for name in group])
    test = {name for group in groups if len(group) > 1 for name in group[::every]}
    train = tuple(name for name in sorted(names) if name not in test)
    how = f"1 in {every} by name" + (" of each folder" if len(folders) > 1 else "")
    note = f"split: {len(train)} train, {len(test)} test ({how})"
    if not test:
        note = f"split: {len(train)} train, none held out: too few views"
    return Split(train, tuple(sorted(test)), (note,))


def _split_by_lists(
    names: Sequence[str],
    listed: tuple[frozenset[str], frozenset[str]],
    root: Path,
    how: str,
) -> Split:
    both = sorted(listed[0] & listed[1])
    if both:
        raise UserError(
            "views are listed for training and for testing",
            where=root / TEST_LIST,
            found=name_some(both),
            todo=f"leave each name in one of {TRAIN_LIST} and {TEST_LIST}",
        )
    train, test = (tuple(name for name in sorted(names) if name in part) for part in listed)
    if not train:
        raise _matches_nothing(
            "no listed view can be trained on", TRAIN_LIST, root, names, listed[0]
        )
    if listed[1] and not test:
        raise _matches_nothing("no listed view can be held out", TEST_LIST, root, names, listed[1])
    notes = [f"split: {len(train)} train, {len(test)} test ({how})"]
    absent = sorted((listed[0] | listed[1]) - set(names))
    if absent:
        notes.append(f"split: {len(absent)} listed names have no posed photo: {name_some(absent)}")
    unlisted = sorted(set(names) - listed[0] - listed[1])
    if unlisted:
        notes.append(
            f"split: {count(len(unlisted), 'view')} in no list left out: {name_some(unlisted)}"
        )
    return Split(train, test, tuple(notes))


def _matches_nothing(
    what: str, file: str, root: Path, names: Sequence[str], listed: frozenset[str]
) -> UserError:
    return UserError(
        what,
        where=root / file,
        expected=f"names below the image folder, such as {min(names)}",
        found=name_some(sorted(listed)) if listed else "no name",
        todo="mend the lists, or use --split every",
    )


def _read_lists(root: Path, names: Sequence[str]) -> tuple[frozenset[str], frozenset[str]] | None:
    """The lists that are there; where there is only one, the other is the rest of the views."""
    train, test = _read_list(root / TRAIN_LIST), _read_list(root / TEST_LIST)
    if train is None and test is None:
        return None
    if train is None or test is None:
        rest = frozenset(names) - (train or test or frozenset())
        return (train, rest) if train is not None else (rest, test or frozenset())
    return train, test


def _read_list(path: Path) -> frozenset[str] | None:
    if not path.is_file():
        return None
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            "the list of views cannot be read",
            where=path,
            found=str(error),
            todo="save it as text in UTF-8, one name a line, or remove it",
        ) from error
    names = (line.strip().replace("\\", "/").removeprefix("./") for line in lines)
    return frozenset(name for name in names if name and not name.startswith("#"))
