"""Second search for poses of photos that mapping left out or misplaced.

Mapping adds a photo by the points of the model that the photo shows, and never checks the pose
again. A photo that shares features with only two other photos shows few points of the model, so
mapping may leave it out. Repeated walls and pavements can give a photo a wrong pose when it is
added. Doubtful photos are therefore placed again by all their pairs (pose_from_pairs.py). Pairs
that contradict the new poses are disabled, points are triangulated again, and mapping continues.
"""

import logging
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from crossgrad_core.commands import check_folder
from crossgrad_plugins.prepare.pose_from_pairs import Pairs, Support, best_place, support
from crossgrad_plugins.prepare.pycolmap_calls import JOURNAL, write_model

if TYPE_CHECKING:
    import pycolmap

#: Maximum number of rounds over all doubtful photos.
_ROUNDS: Final = 5
#: A photo is doubtful if less than the first share of its matches agrees with its pose. Its pose is
#: replaced if another pose has at least the second value times as many agreeing matches.
_DOUBTFUL, _BETTER = 0.6, 1.3
#: Minimum and maximum focal length in units of the photo size, and maximum distortion. These values
#: are COLMAP's own limits.
_POSSIBLE: Final = (0.1, 10.0, 1.0)
_LOG = logging.getLogger(__name__)

Models: TypeAlias = "list[pycolmap.Reconstruction]"
#: Function that triangulates the points of a model again and continues mapping. Its arguments are
#: the folder of the model and the database.
Adjust: TypeAlias = "Callable[[Path, Path], pycolmap.Reconstruction]"
Poses: TypeAlias = "Mapping[int, pycolmap.Rigid3d]"


@dataclass(frozen=True)
class Look:
    """The result of one search: poses of doubtful photos from their pairs.

    Attributes:
        better: Photo -> a pose with more evidence than the photo's current pose.
        settled: Doubtful photos with a pose for which no better pose was found.
        agreeing: Number of matches that agree with the poses of the model, over all photos.
    """

    better: Poses
    settled: frozenset[int]
    agreeing: int


def looked_again(
    models: Models,
    database: Path,
    scratch: Path,
    adjust: Adjust,
    cancelled: Callable[[], bool] = lambda: False,
) -> tuple[Models, frozenset[int]]:
    """Return the models after doubtful photos of the largest model were placed again.

    Args:
        models: The models after mapping. A photo of a smaller model moves to the largest model if
            its pose there has more evidence.
        database: COLMAP's database with the verified matches.
        scratch: An empty folder.
        adjust: Function that triangulates points again and continues mapping.
        cancelled: Function that returns True if the user cancelled the call; it is called for every
            photo.

    Returns:
        The models, and the settled photos of the largest model. Of all rounds, the largest model
        with the most agreeing matches is returned. Settled photos keep their poses, although some
        of their pairs contradict them, because no better pose was found.

    Raises:
        UserError: The disk is full.
    """
    if not models:
        return [], frozenset()
    import pycolmap

    main, *others = sorted(models, key=lambda model: -model.num_reg_images())
    again = _Again(database, scratch / "pairs.db", main, others, cancelled)
    look, moved = again.look(main), frozenset[int]()
    best, seen, gone = main, look, moved
    for number in range(_ROUNDS):
        if not look.better or cancelled():
            break
        changed = pycolmap.Reconstruction(main)
        again.move(changed, look)
        moved |= look.better.keys()
        folder = scratch / str(number)
        folder.mkdir()
        write_model(changed, folder)
        try:
            main = adjust(again.copy, folder)
        except (RuntimeError, ValueError) as error:
            _LOG.warning("doubtful photos keep their poses: pycolmap failed: %s", error)
            break
        _leave_out_impossible(main)
        look = again.look(main)
        # Check all photos again. After many photos have moved, the evidence for a single photo may
        # have changed.
        if look.agreeing >= seen.agreeing:
            best, seen, gone = main, look, moved
    here = set(best.reg_image_ids())
    for model in others:
        for photo in (here & gone).intersection(model.reg_image_ids()):
            model.deregister_frame(model.image(photo).frame_id)
    return [best, *others], seen.settled & here


class _Again:
    """A search for better poses of the photos in a model.

    Args:
        database: COLMAP's database, which is not changed.
        copy: Path of a copy of the database in which pairs are disabled; it is made when it is
            needed.
        main: The largest model.
        others: The other models.
        cancelled: Function that returns True if the user cancelled the call.
    """

    def __init__(
        self,
        database: Path,
        copy: Path,
        main: "pycolmap.Reconstruction",
        others: Models,
        cancelled: Callable[[], bool],
    ) -> None:
        self._database, self.copy, self._others = database, copy, others
        self._cancelled = cancelled
        with _opened(database) as opened:
            self._cameras = _best_known([main, *others], opened)
        self._aside: frozenset[tuple[int, int]] = frozenset()

    def look(self, model: "pycolmap.Reconstruction") -> Look:
        """Return the evidence for photos that are doubtful in a model or missing from it."""
        with _opened(self._database) as database:
            return self._look(model, self._pairs(model, database), self._elsewhere(database))

    def _pairs(self, model: "pycolmap.Reconstruction", database: "pycolmap.Database") -> Pairs:
        return Pairs({**self._cameras, **_cameras_of(model)}, database)

    def _look(
        self,
        model: "pycolmap.Reconstruction",
        pairs: Pairs,
        elsewhere: Mapping[int, Support],
    ) -> Look:
        poses = poses_of(model)
        better, settled, agreeing = {}, set[int](), 0
        for photo in sorted(pairs.partners):
            if self._cancelled():
                break
            sights = pairs.sights(photo, poses)
            here = support(sights, poses[photo]) if photo in poses else Support()
            agreeing += here.matches
            matches = sum(len(sight.features) for sight in sights)
            if photo in poses and here.matches >= _DOUBTFUL * matches:
                continue
            there = elsewhere.get(photo, Support())
            now = here if photo in poses else there
            evidence, pose = best_place(model, sights)
            if pose is not None and evidence.enough and evidence.matches >= _BETTER * now.matches:
                better[photo] = pose
            elif photo in poses and here.enough and there <= here:
                settled.add(photo)
        return Look(better, frozenset(settled), agreeing)

    def _elsewhere(self, database: "pycolmap.Database") -> dict[int, Support]:
        """Return the evidence for poses in the other models, and these models' cameras."""
        evidence = {}
        for model in self._others:
            pairs, poses = Pairs(_cameras_of(model), database), poses_of(model)
            for photo, pose in poses.items():
                evidence[photo] = support(pairs.sights(photo, poses), pose)
        return evidence

    def move(self, model: "pycolmap.Reconstruction", look: Look) -> None:
        """Place photos, disable pairs that contradict the poses, and enable all other pairs.

        After all photos have moved, a photo is left out if too few pairs agree with its pose.
        """
        if not self.copy.exists():
            # Check the free space first, because SQLite aborts the process on a full disk.
            check_folder(self.copy.parent, self._database.stat().st_size + JOURNAL)
            shutil.copyfile(self._database, self.copy)
        with _opened(self._database) as database, _opened(self.copy) as copied:
            for photo, pose in look.better.items():
                _place(model, database, self._cameras, photo, pose)
            pairs, poses = self._pairs(model, database), poses_of(model)
            for photo in look.better:
                if not support(pairs.sights(photo, poses), poses[photo]).enough:
                    model.deregister_frame(model.image(photo).frame_id)
            against = pairs.contradicting(poses_of(model))
            # Remove photos without a pair, because mapping cannot process them.
            for photo in pairs.without(against) & poses_of(model).keys():
                model.deregister_frame(model.image(photo).frame_id)
            for one, two in sorted(self._aside ^ against):
                geometry = database.read_two_view_geometry(one, two)
                if (one, two) in against:
                    geometry.inlier_matches = np.zeros((0, 2), dtype=np.uint32)
                copied.update_two_view_geometry(one, two, geometry)
            self._aside = against


@contextmanager
def _opened(path: Path) -> "Iterator[pycolmap.Database]":
    import pycolmap

    database = pycolmap.Database.open(path)
    try:
        yield database
    finally:
        database.close()


def poses_of(model: "pycolmap.Reconstruction") -> "dict[int, pycolmap.Rigid3d]":
    """Return the pose of each photo, world to camera."""
    return {photo: model.image(photo).cam_from_world() for photo in model.reg_image_ids()}


def _cameras_of(model: "pycolmap.Reconstruction") -> "dict[int, pycolmap.Camera]":
    """Return the cameras of photos with poses, as refined by mapping."""
    numbers = {model.image(photo).camera_id for photo in model.reg_image_ids()}
    return {number: model.camera(number) for number in numbers}


def _best_known(models: Models, database: "pycolmap.Database") -> "dict[int, pycolmap.Camera]":
    """Return each camera from the first model that contains it, or an initial guess.

    Without EXIF, the focal length is guessed from the size of the photos. Mapping has refined such
    a guess for other cameras; the median of these refinements is applied. With a wrong focal
    length, poses have large errors, which bundle adjustment does not always correct.
    """
    cameras: dict[int, pycolmap.Camera] = {}
    for model in models:
        cameras = {**_cameras_of(model), **cameras}
    guessed = [
        camera for camera in database.read_all_cameras() if not camera.has_prior_focal_length
    ]
    ratios = [
        cameras[camera.camera_id].mean_focal_length() / camera.mean_focal_length()
        for camera in guessed
        if camera.camera_id in cameras
    ]
    for camera in guessed:
        if ratios and camera.camera_id not in cameras:
            for index in camera.focal_length_idxs():
                camera.params[index] *= float(np.median(ratios))
            cameras[camera.camera_id] = camera
    return cameras


def _leave_out_impossible(model: "pycolmap.Reconstruction") -> None:
    """Remove photos with impossible camera parameters, even if their matches agree."""
    for photo in list(model.reg_image_ids()):
        image = model.image(photo)
        if model.camera(image.camera_id).has_bogus_params(*_POSSIBLE):
            model.deregister_frame(image.frame_id)


def _place(
    model: "pycolmap.Reconstruction",
    database: "pycolmap.Database",
    cameras: "Mapping[int, pycolmap.Camera]",
    photo: int,
    pose: "pycolmap.Rigid3d",
) -> None:
    """Set the pose of a photo in a model.

    If the model does not contain the photo or its camera, they are added.
    """
    import pycolmap

    image = database.read_image(photo)
    number = image.frame_id
    camera = cameras.get(image.camera_id)
    if (
        camera
        and model.exists_camera(image.camera_id)
        and image.camera_id not in _cameras_of(model)
    ):
        model.camera(image.camera_id).params = list(camera.params)
    if photo not in model.images:
        frame = database.read_frame(number)
        if not model.exists_camera(image.camera_id):
            model.add_camera(camera or database.read_camera(image.camera_id))
        if not model.exists_rig(frame.rig_id):
            model.add_rig(database.read_rig(frame.rig_id))
        if not model.exists_frame(number):
            model.add_frame(frame)
        points = np.asarray(database.read_keypoints(photo)[:, :2], dtype=np.float64)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(point) for point in points])
        model.add_image(image)
    frame = model.frame(number)
    if frame.has_pose():
        model.deregister_frame(number)
    frame.set_cam_from_world(image.camera_id, pose)
    model.register_frame(number)
