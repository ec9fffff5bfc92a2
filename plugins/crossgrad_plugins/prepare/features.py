"""Features of all photos, in COLMAP's database."""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import UserError, available_memory, check_folder, write_atomically
from crossgrad_plugins.prepare.earth import local_positions
from crossgrad_plugins.prepare.layout import Layout
from crossgrad_plugins.prepare.plan import Photo, Plan
from crossgrad_plugins.prepare.pycolmap_calls import JOURNAL, quiet, rows_of, waited

if TYPE_CHECKING:
    import pycolmap

#: Longest side, in pixels, of the reduced photos in which features are searched (COLMAP's default).
LONGEST: Final = 3200
#: Three values for the memory of SIFT. Bytes per pixel, including the upscaling to twice the size
#: (measured in docs/prepare.md). Bytes per pixel of the decoded file, in colour and in grey.
#: Maximum share of the free memory for all threads together.
_BYTES_PER_PIXEL, _BYTES_DECODED, _SHARE = 320, 4, 0.6
#: Photos with fewer pixels than the first value have few features. In these photos, SIFT also
#: accepts fainter features and features along edges. The other values are the contrast threshold
#: and the ratio of curvatures for these photos (COLMAP's defaults: 0.0067 and 10).
_SMALL, _FAINT, _ALONG_EDGES = 1e6, 0.002, 20.0
#: Number of bytes of a feature in the database, and number of stored features per requested
#: feature. The second number is above 1, because a feature with several orientations is stored
#: several times.
_BYTES_OF_FEATURE, _ORIENTATIONS = 152, 1.6
#: Maximum number of photos of a camera that are tried until one of them can be read.
_TRIED: Final = 5


def found_features(layout: Layout, plan: Plan, threads: int) -> dict[str, int]:
    """Find the features; return their number by photo name, 0 for an unreadable photo.

    The features are stored in the database. Photos with stored features are skipped.

    Raises:
        UserError: The disk is full, or pycolmap failed.
    """
    if layout.features.is_file():
        return dict(json.loads(layout.features.read_bytes()))

    check_folder(layout.work, _room(layout, plan))
    if not layout.database.is_file():
        waited("reading cameras", lambda _: _make_database(layout, plan), lambda: "")
    longest = min(plan.settings.max_size or LONGEST, LONGEST)
    small = {photo.name for photo in plan.used if _pixels(photo, longest) < _SMALL}
    names = [photo.name for photo in plan.used]
    for faint in (False, True):
        asked = [name for name in names if (name in small) == faint]
        if asked:
            _find(layout, plan, asked, _options(plan, longest, threads, faint=faint))
    counts = _counts(layout.database)
    by_photo = {name: counts.get(name, 0) for name in names}
    if not any(by_photo.values()):
        raise UserError(
            "no features were found in any photo",
            where=plan.photos,
            expected="sharp, textured photos that are neither black nor white",
            todo="check the photos, or name another folder",
        )
    write_atomically(layout.features, json.dumps(by_photo, indent=1).encode())
    return by_photo


def _room(layout: Layout, plan: Plan) -> int:
    """Return the free bytes that are needed for the missing features.

    They are checked in advance, because SQLite aborts the process on a full disk.
    """
    done = rows_of(layout.database, "descriptors") if layout.database.is_file() else 0
    bytes_per_photo = int(_ORIENTATIONS * plan.settings.max_features) * _BYTES_OF_FEATURE
    return max(0, len(plan.used) - done) * bytes_per_photo + JOURNAL


def _options(
    plan: Plan, longest: int, threads: int, *, faint: bool
) -> "pycolmap.FeatureExtractionOptions":
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = longest
    options.num_threads = _threads(plan.used, longest, threads)
    options.sift.max_num_features = plan.settings.max_features
    if faint:
        options.sift.peak_threshold, options.sift.edge_threshold = _FAINT, _ALONG_EDGES
    return options


def _find(
    layout: Layout, plan: Plan, names: Sequence[str], options: "pycolmap.FeatureExtractionOptions"
) -> None:
    """Find the features of some photos."""
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = plan.settings.lens
    waited(
        "finding features",
        lambda token: pycolmap.extract_features(
            layout.database, Path(plan.photos), names, reader_options=reading,
            extraction_options=options, device=pycolmap.Device.cpu, cancellation_token=token,
        ),
        lambda: f"{rows_of(layout.database, 'descriptors')} of {len(plan.used)} photos",
    )  # fmt: skip


def _threads(photos: Sequence[Photo], longest: int, threads: int) -> int:
    """Return the number of photos that are processed in parallel, limited by the free memory."""
    need = max(
        _BYTES_PER_PIXEL * _pixels(photo, longest) + _BYTES_DECODED * photo.width * photo.height
        for photo in photos
    )
    free = available_memory()
    return threads if free is None else max(1, min(threads, int(_SHARE * free / need)))


def _pixels(photo: Photo, longest: int) -> float:
    scale = min(1.0, longest / max(photo.width, photo.height))
    return photo.width * photo.height * scale**2


def _make_database(layout: Layout, plan: Plan) -> None:
    """Make the database with cameras, photos and GPS positions, but without features."""
    import pycolmap

    scratch = layout.database.with_name(f".{layout.database.name}.tmp")
    scratch.unlink(missing_ok=True)
    shared: Mapping[str, list[Photo]] = defaultdict(list)
    for photo in plan.used:
        shared[photo.camera].append(photo)
    positions = local_positions(plan)
    with quiet():
        database = pycolmap.Database.open(scratch)
        with pycolmap.DatabaseTransaction(database):
            for photos in shared.values():
                _write_camera(database, plan, photos, positions)
        database.close()
    scratch.replace(layout.database)


def _write_camera(
    database: "pycolmap.Database",
    plan: Plan,
    photos: Sequence[Photo],
    positions: Mapping[str, NDArray[np.float64]],
) -> None:
    """Write the photos that have a common calibration."""
    import pycolmap

    camera_id = database.write_camera(_camera(plan, photos))
    rig = pycolmap.Rig()
    rig.add_ref_sensor(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera_id))
    rig_id = database.write_rig(rig)
    for photo in photos:
        image_id = database.write_image(pycolmap.Image(name=photo.name, camera_id=camera_id))
        data = database.read_image(image_id).data_id
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(data)
        database.write_frame(frame)
        if photo.name in positions:
            _write_position(database, data, positions[photo.name])


def _camera(plan: Plan, photos: Sequence[Photo]) -> "pycolmap.Camera":
    """Return the initial calibration.

    The focal length comes from EXIF; without EXIF, it is 1.2 times the longer side.
    """
    import pycolmap

    reading = pycolmap.ImageReaderOptions()
    reading.camera_model = plan.settings.lens
    for photo in photos[:_TRIED]:
        try:
            return pycolmap.infer_camera_from_image(Path(plan.photos) / photo.name, reading)
        except (
            RuntimeError,
            ValueError,
        ):  # Pillow can read this photo but pycolmap cannot, so the photo gets no features.
            continue
    width, height = photos[0].width, photos[0].height
    focal = reading.default_focal_length_factor * max(width, height)
    return pycolmap.Camera.create_from_model_name(0, plan.settings.lens, focal, width, height)


def _write_position(
    database: "pycolmap.Database", data: "pycolmap.data_t", position: NDArray[np.float64]
) -> None:
    """Write a position in local coordinates, because large numbers lose digits."""
    import pycolmap

    system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    database.write_pose_prior(
        pycolmap.PosePrior(corr_data_id=data, position=position, coordinate_system=system)
    )


def _counts(path: Path) -> dict[str, int]:
    """Return the number of features of each photo in the database."""
    import pycolmap

    with quiet():
        database = pycolmap.Database.open(path)
        try:
            return {
                image.name: database.num_keypoints_for_image(image.image_id)
                for image in database.read_all_images()
            }
        finally:
            database.close()
