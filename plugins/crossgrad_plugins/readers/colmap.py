"""Reader of COLMAP scenes: `images/` and `sparse/0/`, binary or text."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.numerics.rotations import matrix_rows
from crossgrad_core.plugin import Reader, Scene, SceneOptions, UserError, is_file
from crossgrad_core.scene.build import build_scene
from crossgrad_core.scene.photos.photo_files import with_photo_names
from crossgrad_core.scene.point_cloud import NO_POINTS, PointCloud
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_core.scene.wording import count
from crossgrad_plugins.readers import _accepts
from crossgrad_plugins.readers._inside import Inside
from crossgrad_plugins.readers.colmap_files.binary import ColmapImage, ColmapModel
from crossgrad_plugins.readers.colmap_files.folder import (
    check_scene_folder,
    choose_model,
)
from crossgrad_plugins.readers.colmap_files.model import model_files, read_model
from crossgrad_plugins.readers.place.place import by_code, by_file, by_gps

#: Name of the file with the georeference, in the model's folder or in the scene's folder.
_GEOREF = "georef.json"
#: If the length of a quaternion is outside this value and its inverse, its square is inaccurate.
_SHORTEST = 1e-100


class ColmapReader(Reader):
    """COLMAP scenes (https://colmap.github.io/format.html), with any perspective camera model.

    Photos are matched with poses by their path in the image folder. If there are several models,
    the model with the most registered images is read.
    """

    images: str = Field("images", description="folder of the photos within the scene")
    model: str | None = Field(
        None, description="folder of the model within the scene, such as sparse/1"
    )
    crs: str | None = Field(None, description="coordinate system of the poses, such as epsg:32633")
    gps: Path | None = Field(
        None,
        description="source of the photo positions: a folder with the original photos, or a list "
        "such as geo.txt; by default georef.json, geo.txt, database.db, the photos",
    )

    @override
    def accepts(self, path: Path) -> bool:
        return _accepts.colmap(path)

    @override
    def read(self, path: Path, options: SceneOptions) -> Scene:
        raw = read_raw(path, self.images, self.model, options)
        return self.placed(build_scene(raw, options), raw)

    def placed(self, scene: Scene, raw: RawScene) -> Scene:
        """Return the scene with its georeference, if its position on Earth is known.

        Raises:
            UserError: A file that an option names, or a `georef.json`, is missing or unreadable.
        """
        if self.crs is not None and self.gps is not None:
            raise UserError(
                "reader.crs and reader.gps cannot be combined: the poses already have a "
                "coordinate system",
                where="reader.crs, reader.gps",
                todo="leave one of them out",
            )
        if self.crs is not None:
            return by_code(scene, self.crs)
        files = (choose_model(raw.root, self.model)[0] / _GEOREF, raw.root / _GEOREF)
        file = next((file for file in files if is_file(file)), None)
        if file is not None and self.gps is None:
            return by_file(scene, file)
        return by_gps(scene, raw, self.gps)


def read_raw(path: Path, images: str, wanted: str | None, options: SceneOptions) -> RawScene:
    """Return a COLMAP scene as stored in its files.

    If the model has no points, a PLY is searched in the model's folder and in the folders above it
    within the scene.

    Args:
        path: The scene's folder.
        images: Folder of the photos within the scene.
        wanted: Folder of the model within the scene; None for the model with most images.
        options: The reader's options; if they name a file of points, no PLY is searched.

    Raises:
        UserError: There is no model, or a file of the model cannot be read.
    """
    check_scene_folder(path)
    folder, notes = choose_model(path, wanted)
    model = read_model(folder)
    form = "binary" if (folder / "cameras.bin").is_file() else "text"
    notes.append(
        f"COLMAP: {count(len(model.images), 'posed image')}, "
        f"{count(len(model.cameras), 'camera')}, {count(len(model.points), 'SfM point')} from "
        f"{os.path.relpath(folder, path)} ({form})"
    )
    views = _make_views(model, folder)
    points, files = PointCloud(model.points, model.colors), model_files(folder)
    if not len(model.points):
        points = _beside(path, folder, views, options)
        if points.source:
            notes.append(f"COLMAP: {points.note}")
            files = (*files, path / points.source)
    return with_photo_names(
        RawScene(
            root=path,
            images=path / images,
            views=views,
            points=points.positions,
            point_colors=points.colors,
            notes=tuple(notes),
            files=files,
        )
    )


def _beside(
    scene: Path, model: Path, views: tuple[RawView, ...], options: SceneOptions
) -> PointCloud:
    """Return the points of a PLY in the model's folder, or in a folder above within the scene."""
    from crossgrad_plugins.readers._raw import find_points

    inside, base = Inside(scene), Path(os.path.relpath(model, scene))
    places = [base, *base.parents] if ".." not in base.parts else []
    for folder in places:
        points = find_points(inside, options, None, scene, base=folder.as_posix())
        if points.source:
            check_seen(points, views, scene / points.source)
            return points
    return NO_POINTS


def _make_views(model: ColmapModel, folder: Path) -> tuple[RawView, ...]:
    order = np.argsort(model.point_ids, kind="stable")
    ids = model.point_ids[order]
    return tuple(
        RawView(
            name=image.name.replace("\\", "/").removeprefix("./"),
            calibration=model.cameras[_checked_camera(image, model, folder)],
            world_to_camera=_make_pose(image, folder),
            seen=_find_rows(image.points, ids, order),
        )
        for image in model.images
    )


def _checked_camera(image: ColmapImage, model: ColmapModel, folder: Path) -> int:
    if image.camera in model.cameras:
        return image.camera
    raise UserError(
        f"the camera of image {image.name} is missing in the model",
        where=folder,
        expected=f"one of {sorted(model.cameras)[:10]}",
        found=f"camera id {image.camera}",
        todo="use cameras and images of the same model: export it again",
    )


def _find_rows(
    points: NDArray[np.uint64], ids: NDArray[np.uint64], order: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the row of each point id; ids that the model does not contain are left out."""
    if not len(ids):
        return np.zeros(0, dtype=np.int64)
    # Sort the ids first, because this makes `searchsorted` many times faster.
    points = np.sort(points)
    positions = np.minimum(np.searchsorted(ids, points), len(ids) - 1)
    return np.asarray(order[positions[ids[positions] == points]], dtype=np.int64)


def _make_pose(image: ColmapImage, folder: Path) -> NDArray[np.float64]:
    """Return the pose [4, 4], world to camera."""
    largest = np.abs(image.quaternion).max()
    if not (_SHORTEST < largest < 1 / _SHORTEST) or not np.isfinite(image.translation).all():
        raise UserError(
            "a pose contains numbers that are not finite",
            where=f"{folder}: image {image.name}",
            found=f"quaternion {image.quaternion.tolist()}, translation "
            f"{image.translation.tolist()}",
            todo="remove the image from the model, or estimate the poses again",
        )
    pose = np.eye(4)
    pose[:3, :3] = matrix_rows(*(image.quaternion / np.linalg.norm(image.quaternion)))
    pose[:3, 3] = image.translation
    return pose
