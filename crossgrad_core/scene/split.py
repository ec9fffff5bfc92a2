"""Split the views into training views and held-out views."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Final, TypeAlias

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.file_names import FileNames
from crossgrad_core.scene.wording import count, name_some
from crossgrad_core.system.input_files import read_file

TRAIN_LIST = "train_list.txt"
TEST_LIST = "test_list.txt"

#: Function that maps the names of training views to the regimes of all views. If photos are not in
#: several folders, the regimes depend on a median over the training views.
Label: TypeAlias = Callable[[Sequence[str]], Mapping[str, str]]

_LINES: Final = {b"\n": 150}  # Estimated memory in bytes for each name.

#: A mean over fewer held-out views does not describe a regime.
_FEWEST: Final = 2


@dataclass(frozen=True)
class Split:
    """The names of the training views and of the held-out views, and the reason for this choice.

    Attributes:
        train: Names of the training views, sorted.
        test: Names of the held-out views, sorted.
        notes: Notes to the user about the choice of the views.
        regimes: Regime of each view, by name; None if the views were not chosen by regime.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    notes: tuple[str, ...]
    regimes: Mapping[str, str] | None = None


def split_views(
    names: Sequence[str],
    options: SceneOptions,
    root: Path,
    given: tuple[frozenset[str], frozenset[str]] | None = None,
    label: Label = lambda _: {},
) -> Split:
    """Split views as the option `split` requires. At least one view is a training view.

    `auto` first uses list files or the split that the input prescribes. A split by folder may hold
    out fewer than two photos of a regime. If a split by regime would hold out two or more photos of
    this regime, `auto` uses the split by regime instead.

    Args:
        names: Names of all views that can be used.
        options: Scene options; `split` and `test_every` are used.
        root: Folder of the scene, which may contain `train_list.txt` and `test_list.txt`.
        given: Names of training and held-out views that the input prescribes. List files have
            priority.
        label: Function that returns the regimes. By default, views have no regimes.

    Raises:
        UserError: The lists contradict each other, match no view, or leave no training view.
    """
    if options.split == "none":
        return Split(
            tuple(sorted(names)), (), (f"split: all {len(names)} views are training views",)
        )
    if options.split == "auto":
        for listed, how in ((_read_lists(root, names), "by lists"), (given, "as given")):
            if listed is not None:
                return _split_by_lists(names, listed, root, how)
    every = _split_every(names, options.test_every)
    return every if options.split == "every" else _by_regime(every, names, options, label)


def _by_regime(every: Split, names: Sequence[str], options: SceneOptions, label: Label) -> Split:
    """Return the split by regime if the option requires this split.

    Also return the split by regime if the split `every` has too few held-out views of a regime.
    """
    regimes = label(names)
    stratified = _split_stratified(names, options.test_every, regimes)
    if options.split == "stratified":
        return stratified
    few, most = _held_out(every, label(every.train)), _held_out(stratified, regimes)
    gained = sorted(name for name, held_out in most.items() if few[name] < _FEWEST <= held_out)
    if not gained:
        return every
    counts = ", ".join(f"{count(few[name], 'photo')} of {name}" for name in gained)
    why = f"split: by regime, since 1 in {options.test_every} by name would hold out {counts}"
    return replace(stratified, notes=(*stratified.notes, why))


def _split_every(names: Sequence[str], every: int) -> Split:
    """Hold out every n-th view of each folder, in alphabetical order."""
    folders = {name: str(PurePosixPath(name).parent) for name in names}
    how = " in each folder" if len(set(folders.values())) > 1 else ""
    return _split_each(folders, every, how)


def _split_stratified(names: Sequence[str], every: int, regimes: Mapping[str, str]) -> Split:
    """Hold out every n-th view of each regime, in alphabetical order.

    `regimes` contains the regimes of all views.
    """
    return replace(
        _split_each({name: regimes.get(name, "") for name in names}, every, " in each regime"),
        regimes=regimes,
    )


def _split_each(groups: Mapping[str, str], every: int, how: str) -> Split:
    """Hold out every n-th view of each group, in alphabetical order.

    Groups with only one view are merged into one group.
    """
    members = defaultdict(list)
    for name in sorted(groups):
        members[groups[name]].append(name)
    parts = [group for group in members.values() if len(group) > 1]
    parts.append([name for group in members.values() if len(group) == 1 for name in group])
    test = {name for group in parts if len(group) > 1 for name in group[::every]}
    train = tuple(name for name in sorted(groups) if name not in test)
    note = f"split: {len(train)} train, {len(test)} test (1 in {every} by name{how})"
    if not test:
        note = f"split: {len(train)} train, none held out: too few views"
    return Split(train, tuple(sorted(test)), (note,))


def _held_out(split: Split, regimes: Mapping[str, str]) -> Counter[str]:
    """Return the number of held-out views of each regime."""
    return Counter(regimes[name] for name in split.test if name in regimes)


def _split_by_lists(
    names: Sequence[str],
    listed: tuple[frozenset[str], frozenset[str]],
    root: Path,
    how: str,
) -> Split:
    # If the input prescribes the split, no list files exist. If no list files exist, the message
    # names the scene's folder.
    places = [root / file if how == "by lists" else root for file in (TRAIN_LIST, TEST_LIST)]
    both = sorted(listed[0] & listed[1])
    if both:
        raise UserError(
            "a view is listed for both training and testing",
            where=places[1],
            found=name_some(both),
            todo=f"remove each name from one of {TRAIN_LIST} and {TEST_LIST}",
        )
    train, test = (
        tuple(name for name in sorted(names) if name in names_in_list) for names_in_list in listed
    )
    if not train:
        raise _matches_nothing(
            "no listed view can be used for training", places[0], names, listed[0]
        )
    if listed[1] and not test:
        raise _matches_nothing("no listed view can be held out", places[1], names, listed[1])
    notes = [f"split: {len(train)} train, {len(test)} test ({how})"]
    absent = sorted((listed[0] | listed[1]) - set(names))
    if absent:
        notes.append(
            f"split: {len(absent)} listed names have no photo with a pose: {name_some(absent)}"
        )
    unlisted = sorted(set(names) - listed[0] - listed[1])
    if unlisted:
        notes.append(
            f"split: {count(len(unlisted), 'view')} left out (in no list): {name_some(unlisted)}"
        )
    return Split(train, test, tuple(notes))


def _matches_nothing(
    what: str, path: Path, names: Sequence[str], listed: frozenset[str]
) -> UserError:
    return UserError(
        what,
        where=path,
        expected=f"names of photos relative to the image folder, such as {min(names)}",
        found=name_some(sorted(listed)) if listed else "no name",
        todo="correct the lists, add the missing photos, or use --split every",
    )


def has_lists(root: Path) -> bool:
    """Return True if the scene's folder contains a list of training views or of held-out views."""
    return any((root / name).is_file() for name in (TRAIN_LIST, TEST_LIST))


def _read_lists(root: Path, names: Sequence[str]) -> tuple[frozenset[str], frozenset[str]] | None:
    """Read the list files.

    If only one list exists, the other list consists of all remaining views.
    """
    train, test = (_read_list(root / file, names) for file in (TRAIN_LIST, TEST_LIST))
    if train is None and test is None:
        return None
    if train is None or test is None:
        rest = frozenset(names) - (train or test or frozenset())
        return (train, rest) if train is not None else (rest, test or frozenset())
    return train, test


def _read_list(path: Path, views: Sequence[str]) -> frozenset[str] | None:
    """Read the names in a list file.

    A name that matches a view is replaced by the name of the view.

    Return None if the list file does not exist.
    """
    if not path.is_file():
        return None
    try:
        lines = read_file(path, _LINES).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            "the list of views cannot be read",
            where=path,
            found=str(error),
            todo="save the list as UTF-8 text with one name per line, or remove it",
        ) from error
    cleaned = (line.strip().replace("\\", "/").removeprefix("./") for line in lines)
    names = [name for name in cleaned if name and not name.startswith("#")]
    view_by_name = FileNames(views).pair(names).files
    return frozenset(view_by_name.get(name, name) for name in names)
