"""Reader of NeRF synthetic scenes, rendered by Blender: `transforms_train.json` and others."""

from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import read_object
from crossgrad_plugins.readers._raw import find_points, raw_scene
from crossgrad_plugins.readers._transforms import Posed, raw_views, read_frame
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder

#: Files of held-out views; the first file that exists is used. If the test file exists, validation
#: views are not used.
_HELD_OUT: Final = ("transforms_test.json", "transforms_val.json")
_BEHIND: Final = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "none": None}


class BlenderReader(Reader):
    """NeRF synthetic scenes: `transforms_train.json`, `transforms_test.json` and photos.

    Fields have the names of nerfstudio's format. Most files only contain `camera_angle_x`. The
    alpha channel of a photo is the fraction of each pixel that the object covers. Photos are
    blended over `reader.background` (white, as in NeRF). The option `--background` should give the
    same colour.
    """

    folder: str = Field(".", description="folder of the transforms files within the scene")
    background: Literal["white", "black", "none"] = Field(
        "white",
        description="background colour behind photos with transparency; none: pixels with alpha "
        "below one half are ignored",
    )
    points: str | None = Field(
        None,
        description="PLY file of points within the scene; by default a PLY file next to the "
        "transforms file",
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.blender(path, self.folder)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        # The scene's own folder is not part of names inside the scene.
        file = inside.name(_accepts.BLENDER_FILE, "reader.folder", self.folder)
        base = file[: -len(_accepts.BLENDER_FILE)]
        train = _read(inside, file, base)
        held_out = next(
            (f"{base}{name}" for name in _HELD_OUT if (path / base / name).exists()), ""
        )
        test = _read(inside, held_out, base) if held_out else []
        images, views = raw_views([*train, *test])
        names = [view.name for view in views]
        asked = self.points if self.points is None else inside.name(self.points, "reader.points")
        points = find_points(inside, options, asked, "reader.points", base="" if asked else base)
        check_seen(points, views, path / file)
        behind = f", photos with transparency over {self.background} (see --background)"
        note = f"blender: {count(len(views), 'posed image')}, {points.note}{behind}"
        raw = raw_scene(inside, images, views, points, note)
        split = frozenset(names[: len(train)]), frozenset(names[len(train) :])
        background = _BEHIND[self.background]
        return build_scene(
            replace(raw, split=split if held_out else None, background=background), options
        )


def _read(inside: Inside, name: str, base: str) -> list[Posed]:
    whole = read_object(inside.file(name, "reader.folder"))
    return [read_frame(inside, frame, whole, base) for frame in whole.items("frames")]
