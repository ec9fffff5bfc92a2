"""Reader of nerfstudio scenes: `transforms.json` with photos, lenses, masks and points."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.split import has_lists
from crossgrad_core.scene.wording import count, name_some
from crossgrad_plugins.georeference.frames import Frame3D, rotation_of
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers._json import Fields, read_object
from crossgrad_plugins.readers._raw import find_points, raw_scene
from crossgrad_plugins.readers._transforms import (
    photo_name,
    raw_views,
    read_frame,
    transform_of,
)
from crossgrad_plugins.readers.colmap_files.folder import check_scene_folder
from crossgrad_plugins.readers.place.place import by_gps

#: Fields with the lists of training views and of held-out views. Of the lists of held-out views,
#: the first list that contains views is used.
_TRAIN, *_HELD_OUT = "train_filenames", "test_filenames", "val_filenames"


class NerfstudioReader(Reader):
    """`transforms.json` of nerfstudio and instant-ngp, with any lens that can be undistorted.

    Format: https://docs.nerf.studio/quickstart/data_conventions.html. `applied_transform` and
    `applied_scale` are inverted, so that cameras and points get their original coordinates.
    `train_filenames` and `test_filenames` (or else `val_filenames`) give the split. A file
    train_list.txt or test_list.txt overrides them.
    """

    file: str = Field(_accepts.TRANSFORMS_FILE, description="file of the frames within the scene")
    points: str | None = Field(
        None,
        description="PLY file of points within the scene; by default the PLY that the file "
        "names, or one next to it",
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.nerfstudio(path, self.file)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        check_scene_folder(path)
        inside = Inside(path)
        name = inside.name(self.file, "reader.file")
        base = str(PurePosixPath(name).parent)
        whole = read_object(inside.file(name, "reader.file"))
        world = _applied(whole).inverse
        frames = [read_frame(inside, frame, whole, base, world) for frame in whole.items("frames")]
        images, views = raw_views(frames)
        points = find_points(inside, options, *self._points(whole, base), frame=world)
        check_seen(points, views, whole.file)
        notes = [f"nerfstudio: {count(len(views), 'posed image')}, {points.note}"]
        if "fisheye_crop_radius" in whole:
            notes.append("nerfstudio: fisheye_crop_radius is not supported; use masks instead")
        raw = raw_scene(inside, images, views, points, *notes)
        if options.split == "auto" and not has_lists(path):
            names = [view.name for view in views]
            raw = replace(raw, split=_split(inside, whole, base, images, names))
        return by_gps(build_scene(raw, options), raw)

    def _points(self, whole: Fields, base: str) -> tuple[str | None, object]:
        """Return the requested file of points, and the position of its name in the files."""
        if self.points is not None:
            return self.points, "reader.points"
        if "ply_file_path" in whole:
            where = whole.where("ply_file_path")
            named = whole.text("ply_file_path")
            return str(PurePosixPath(base, named)) if not named.startswith("/") else named, where
        return None, whole.file


def _applied(whole: Fields) -> Frame3D:
    """Return the transform from the original coordinates of the poses to those of the file."""
    scale = whole.positive("applied_scale") if "applied_scale" in whole else 1.0
    if "applied_transform" not in whole:
        return Frame3D(np.eye(3), np.zeros(3), scale)
    matrix = transform_of(whole, "applied_transform")
    rotation = rotation_of(matrix[:, :3])
    if rotation is None:
        whole.wrong("applied_transform", "an orthonormal, right-handed rotation and a translation")
    return Frame3D(rotation, scale * matrix[:, 3], scale)


def _split(
    inside: Inside, whole: Fields, base: str, images: str, posed: Sequence[str]
) -> tuple[frozenset[str], frozenset[str]] | None:
    """Return the names of training and held-out views in the photo folder; None without lists.

    Raises:
        UserError: A list contains a name that is not the photo of a frame, or a name is in two
            lists.
    """
    if _TRAIN not in whole:
        return None
    lists = {key: _listed(inside, whole, key, base, images)
             for key in (_TRAIN, *_HELD_OUT) if key in whole}  # fmt: skip
    held_out = next((key for key in _HELD_OUT if lists.get(key)), None)
    for key in filter(None, (_TRAIN, held_out)):
        if not lists[key] & set(posed):
            raise UserError(
                "no name in a split list matches the photo of a frame",
                where=whole.where(key),
                expected=f"names as in the frames' file_path, such as {min(posed)}",
                found=name_some(whole.texts(key)) or "no name",
                todo="correct the list, or use --split every",
            )
    test = lists[held_out] if held_out else frozenset[str]()
    both = sorted(lists[_TRAIN] & test)
    if both:
        raise UserError(
            "a view is listed for both training and testing",
            where=f"{whole.where(_TRAIN)} and {held_out}",
            found=name_some(both),
            todo="remove each name from one of the two lists, or use --split every",
        )
    return lists[_TRAIN], test


def _listed(inside: Inside, whole: Fields, key: str, base: str, images: str) -> frozenset[str]:
    names = [photo_name(inside, text, whole.where(key), base) for text in whole.texts(key)]
    start = "" if images == "." else f"{images}/"
    return frozenset(name.removeprefix(start) for name in names)
