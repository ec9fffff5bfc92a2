"""Lists that users write: split lists, and labels of views."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene import split
from crossgrad_core.scene.split import TEST_LIST, TRAIN_LIST, split_views
from crossgrad_core.system import text_files
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.mutate import matcher
from crossgrad_fuzz.target import Target
from crossgrad_plugins.groupings import lists
from crossgrad_plugins.groupings.lists import _folder, _listed, _require_two, read_labels

_NAMES = ("far/0001.jpg", "far/0002.jpg", "near/0001.jpg", "near/0002.jpg", "größe.jpg")
_LABELS = "labels.csv"


def _split_seeds() -> Sequence[Case]:
    train = b"# those\nfar/0001.jpg\nnear/0001.jpg\n./near/0002.jpg\n"
    test = "far\\0002.jpg\ngröße.jpg\n".encode()
    return [
        {TRAIN_LIST: train, TEST_LIST: test},
        {TRAIN_LIST: train},
        {TEST_LIST: test},
        {TEST_LIST: b"far/0001.jpg\n", TRAIN_LIST: b"far/0002.jpg\nnobody.jpg"},
        {TEST_LIST: b"", TRAIN_LIST: b"\xef\xbb\xbffar/0002.jpg\r\n"},
    ]


def _parse_split(folder: Path) -> None:
    found = split_views(_NAMES, SceneOptions(), folder)
    assert found.train
    assert set(found.train) <= set(_NAMES)
    assert set(found.test) <= set(_NAMES)
    assert not set(found.train) & set(found.test)
    assert split_views(_NAMES[:1], SceneOptions(split="every"), folder).train
    for how in ("none", "every", "stratified", "auto"):
        options = SceneOptions(split=how, test_every=2)
        elsewhere = folder if how != "auto" else folder / "without lists"
        parted = split_views(_NAMES, options, elsewhere, label=_regimes)
        assert parted.train
        assert set(parted.train) <= set(_NAMES)


def _regimes(names: Sequence[str]) -> Mapping[str, str]:
    return {name: "far" if name.startswith("far/") else "near" for name in names}


def _label_seeds() -> Sequence[Case]:
    return [
        {_LABELS: "# view, label\nfar/,far\nnear/,near\ngröße.jpg,near\n".encode()},
        {_LABELS: "\ufefffar/,far\r\nnear/0001.jpg,near\r\nnear/,n\r\ngröße.jpg,x\r\n".encode()},
        {_LABELS: '"far/","a, b"\n"near/",c\n"größe.jpg","d ""e"""\n'.encode()},
    ]


def _parse_labels(folder: Path) -> None:
    path = folder / _LABELS
    table = read_labels(path)
    assert all(name and label for name, label in table.items())
    _require_two({_folder(name) for name in table}, None)
    labels = [_listed(name, table, path) for name in _NAMES]
    _require_two(set(labels), path)
    assert all(labels)


SPLIT = Target(
    name="split-lists",
    seeds=_split_seeds,
    parse=_parse_split,
    parser={split: ()},
    words=tuple(name.encode() + b"\n" for name in _NAMES),
)
LABELS = Target(
    name="labels",
    seeds=_label_seeds,
    parse=_parse_labels,
    parser={text_files: ("read_json", "parse_number"), lists: ("Lists",)},
    words=(*(name.encode() for name in _NAMES), b"far/", b",", b'"', b"\n", b"#", b'""', b",,"),
    mutators=(matcher(rb",(\w+)", (b"far", b"near")), matcher(rb"([\w/.]+),", (b"far/", b"near/"))),
)
TARGETS = (SPLIT, LABELS)
