"""Reader of MatrixCity scenes: blocks with `transforms.json` and `rgb/`, as published.

Source of the format: README of https://github.com/city-super/MatrixCity (NeRF's axes; positions in
metres; the rotation in `rot_mat` must be multiplied by 100).
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Final

from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.wording import count
from crossgrad_plugins.georeference.frames import rotation_of
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._cameras import from_opengl
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields, read_object
from crossgrad_plugins.readers._raw import find_points, raw_scene
from crossgrad_plugins.readers._transforms import Posed, raw_views, read_lens, transform_of
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder

_TO_UNIT: Final = 100.0
_PHOTOS: Final = "rgb"


class MatrixCityReader(Reader):
    """Blocks of MatrixCity: `transforms.json` with `rot_mat` and `frame_index`, and photos.

    Photos are in the folder `rgb/`, or in the folder of the pose file. A scene is one block, or a
    folder that contains several blocks. A block is held out if it is in a folder `test`, or if its
    name ends with `_test`.
    """

    points: str | None = Field(
        None, description="PLY file of points within the scene; by default a PLY file in its folder"
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.matrixcity(path)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        files = _accepts.pose_files(path)
        if not files:
            raise UserError(
                "the folder contains no MatrixCity block",
                where=path,
                expected=f"{_accepts.TRANSFORMS_FILE} with the poses and {_PHOTOS}/ with the "
                "photos of a block",
                todo="name the folder of a block, or a folder that contains blocks",
            )
        frames = {name: _read(inside, name) for name in files}
        images, views = raw_views([frame for block in frames.values() for frame in block])
        points = find_points(inside, options, self.points, "reader.points")
        check_seen(points, views, path)
        names = [view.name for view in views]
        held_out = [_is_test(name) for name in files for _ in frames[name]]
        test = frozenset(name for name, out in zip(names, held_out, strict=True) if out)
        blocks = f"{count(len(views), 'posed image')} in {count(len(files), 'block')}"
        raw = raw_scene(inside, images, views, points, f"MatrixCity: {blocks}, {points.note}")
        split = (frozenset(names) - test, test) if test else None
        return build_scene(replace(raw, split=split), options)


def _is_test(name: str) -> bool:
    folders = PurePosixPath(name).parts[:-1]
    return "test" in folders or (bool(folders) and folders[-1].endswith("_test"))


def _read(inside: Inside, name: str) -> list[Posed]:
    whole = read_object(inside.file(name, inside.scene / name))
    base = PurePosixPath(name).parent
    photos = str(base / _PHOTOS if (inside.scene / base / _PHOTOS).is_dir() else base)
    return [_frame(inside, frame, whole, photos) for frame in whole.items("frames")]


def _frame(inside: Inside, frame: Fields, whole: Fields, photos: str) -> Posed:
    index = frame.number("frame_index")
    if index != int(index) or index < 0:
        frame.wrong("frame_index", "a whole number of at least 0")
    photo = inside.name(f"{int(index):04d}.png", frame.where("frame_index"), photos)
    matrix = transform_of(frame, "rot_mat")
    rotation = rotation_of(_TO_UNIT * matrix[:, :3])
    if rotation is None:
        frame.wrong("rot_mat", "a right-handed rotation scaled by 1/100, and a translation")
    return Posed(photo, read_lens(inside, frame, whole, photo), from_opengl(rotation, matrix[:, 3]))
