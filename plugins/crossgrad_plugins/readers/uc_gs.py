"""Reader of UC-GS scenes: a COLMAP model whose photo names mark held-out photos."""

from dataclasses import replace
from pathlib import Path, PurePosixPath

from typing_extensions import override

from crossgrad_core.plugin import Scene, SceneOptions
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers.colmap import ColmapReader, read_raw

#: Prefixes of photo folders for training and held-out photos.
_TRAIN, _TEST = "train", "test"


class UcGsReader(ColmapReader):
    """COLMAP scenes whose photo folders begin with `train` and `test`, as in UC-GS.

    A photo is held out if one of its folders begins with `test`, or if its name contains the word
    `eval`. All other photos are used for training. The names of further folders (`aerial`,
    `street`) are the regimes. Without such folders, views are divided into regimes by their
    footprint.
    """

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.uc_gs(path, self.images)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        raw = read_raw(path, self.images, self.model, options)
        test = frozenset(view.name for view in raw.views if _accepts.is_held_out(view.name))
        train = frozenset(view.name for view in raw.views) - test
        views = tuple(replace(view, place=_place(view.name)) for view in raw.views)
        note = f"UC-GS: {count(len(test), 'posed image')} held out by folder or name"
        split = (train, test) if train and test else None
        raw = replace(raw, views=views, split=split, notes=(*raw.notes, note))
        return self.placed(build_scene(raw, options), raw)


def _place(name: str) -> str:
    """Return a name without folders that separate training from held-out photos."""
    *folders, file = PurePosixPath(name).parts
    kept = [folder for folder in folders if not folder.lower().startswith((_TRAIN, _TEST))]
    return "/".join((*kept, file))
