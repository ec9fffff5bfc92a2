"""The ledger of a scene's folder: notes on the files that nothing uses, with the reason."""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.scene.file_kinds import COPY, DEPTH, MASK, PHOTO, POINTS, RAW, kind_of
from crossgrad_core.scene.photo_files import walked
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count, name_some

#: Files of crossgrad: a folder with one of the first was written by a run or by `prepare`.
_OWN_FOLDERS: Final = frozenset({"config.yaml", "plan.json"})
_OWN_FILES: Final = frozenset({"report.png"})
#: Folders with a note of their own.
_MOST: Final = 8


def note_unused(raw: RawScene, used: Iterable[Path], masks: Path | None) -> list[str]:
    """Return a note for each folder and reason: photos, masks, depth, points and tables not used.

    Photos without a pose in the photo folder are left out: they have a note of their own.

    Args:
        raw: The scene.
        used: Files that are used, in addition to those of the reader.
        masks: The folder of the masks, if any.
    """
    groups = defaultdict[tuple[str, str], list[str]](list)
    for name, reason in _unused(raw, [*used, *raw.files], masks).items():
        path = PurePosixPath(name)
        groups[path.parent.as_posix(), reason].append(path.name)
    listed = sorted(groups.items())
    notes = [
        f"unused: {count(len(names), 'file')} in {_shown(raw, folder)} "
        f"({name_some(sorted(names))}), {reason}"
        for (folder, reason), names in listed[:_MOST]
    ]
    if rest := listed[_MOST:]:
        number = sum(len(names) for _, names in rest)
        folders = sorted({_shown(raw, folder) for (folder, _), _ in rest})
        notes.append(f"unused: {count(number, 'more file')} in {name_some(folders)}")
    return notes


def _unused(raw: RawScene, used: Iterable[Path], masks: Path | None) -> dict[str, str]:
    """Files that are not used, as they are or through links, and the reasons."""
    known, home = set(map(os.path.abspath, used)), os.path.abspath(raw.root)
    files = [name for name in _files(raw.root) if os.path.join(home, name) not in known]
    reasons = {name: reason for name in files if (reason := _reason(name, raw, masks))}
    if not reasons:
        return {}
    true = set(map(os.path.realpath, known))
    return {
        name: reason
        for name, reason in reasons.items()
        if os.path.realpath(os.path.join(home, name)) not in true
    }


def _files(root: Path) -> Iterator[str]:
    """Paths of the files below a scene, without hidden ones and what crossgrad writes."""
    for below, folders, files in walked(root):
        if below != "." and _OWN_FOLDERS & set(files):
            folders.clear()
            continue
        folders[:] = [name for name in folders if not name.startswith((".", "__"))]
        for name in files:
            if not name.startswith(".") and name not in _OWN_FILES:
                yield name if below == "." else f"{below}/{name}"


def _reason(name: str, raw: RawScene, masks: Path | None) -> str | None:
    """Why a file is not used; None for a file of no known kind, or with a note of its own."""
    kind, path = kind_of(name), raw.root / name
    if kind is None or (kind is PHOTO and path.is_relative_to(raw.images)):
        return None
    if masks is not None and kind in {PHOTO, MASK} and path.is_relative_to(masks):
        return "masks of no photo that is used"
    if kind is MASK:
        return "named like masks; use them with --set data.masks=FOLDER"
    if kind is POINTS:
        own = "the scene has its own points" if len(raw.points) else "not a name that is looked for"
        return f"{own}; start from such a file with --points FILE"
    return {
        RAW: "a camera's own format; save the photos as JPEG or PNG to use them",
        DEPTH: "depth and normal maps are not used",
        COPY: "smaller copies of the photos are read with --max-size only",
        PHOTO: f"outside the photo folder {_shown(raw, os.path.relpath(raw.images, raw.root))}",
    }.get(kind, "not a table that the reader takes")


def _shown(raw: RawScene, folder: str) -> str:
    return f"{raw.root.resolve().name}/" if folder == "." else f"{folder}/"
