"""Reads scenes in the manner of UC-GS: a COLMAP model whose names tell what is held out."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Final

from typing_extensions import override

from crossgrad_core.plugin import Scene, SceneOptions
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers._colmap_folder import find_models
from crossgrad_plugins.readers.colmap import ColmapReader, read_raw

#: Names of photo folders, and what a name of a held-out photo holds.
_TRAIN, _TEST = "train", "test"
_EVAL: Final = re.compile(r"(?<![a-z])eval(?![a-z])")
#: Photos that are looked at to recognise such a scene.
_MOST: Final = 10_000


class UcGsReader(ColmapReader):
    """COLMAP scenes whose photo folders begin with `train` and `test`, as those of UC-GS.

    Held out are photos below a folder that begins with `test`, and those with the word `eval` in
    their name; all others are trained on. Regimes are told by further folders (`aerial`,
    `street`), else by footprint.
    """

    @override
    def accepts(self, path: Path) -> bool:
        try:
            return bool(find_models(path)) and any(map(is_test, _names(path / self.images)))
        except OSError:
            return False

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        raw = read_raw(path, self.images, self.model, options)
        test = frozenset(view.name for view in raw.views if is_test(view.name))
        train = frozenset(view.name for view in raw.views) - test
        views = tuple(replace(view, place=_place(view.name)) for view in raw.views)
        note = f"UC-GS: {count(len(test), 'posed image')} for testing by folder or name"
        split = (train, test) if train and test else None
        raw = replace(raw, views=views, split=split, notes=(*raw.notes, note))
        return self.placed(build_scene(raw, options), raw)


def is_test(name: str) -> bool:
    """Whether a photo of this name is held out."""
    path = PurePosixPath(name)
    folders = (folder.lower() for folder in path.parts[:-1])
    named = _EVAL.search(path.name.lower()) is not None
    return named or any(each.startswith(_TEST) for each in folders)


def _names(images: Path) -> Iterator[str]:
    """Names of photos below a folder, in two folders at most; the first many of them."""
    found = (path for pattern in ("*.*", "*/*.*", "*/*/*.*") for path in images.glob(pattern))
    for _, path in zip(range(_MOST), found, strict=False):
        yield path.relative_to(images).as_posix()


def _place(name: str) -> str:
    """A name without the folders that tell training from held-out photos."""
    *folders, file = PurePosixPath(name).parts
    kept = [each for each in folders if not each.lower().startswith((_TRAIN, _TEST))]
    return "/".join((*kept, file))
