"""Make the bundled scene `boruszyn` from the 800 px COLMAP scene `boruszyn_kap`.

    python make_boruszyn.py SOURCE TARGET

Photos and camera are resized to 400 px; every SfM point is kept. To keep the scene small, each
track keeps only every eighth observation, and at least one. The observations show which view saw
which part of the scene. Training itself starts from the points alone.
"""

import sys
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

from crossgrad_core.scene.photos.decode import resize

LONG_SIDE = 400
QUALITY = 90
KEPT_SHARE = 8

README = """\
boruszyn: kite aerial photos of Boruszyn, Poland, 2012-08-19, as a COLMAP scene

Photos: Andrew Zaborowski, with attribution to OpenStreetMap-PL.
Licence: CC-BY 3.0, http://creativecommons.org/licenses/by/3.0/
Source: https://github.com/merkato/odm_boruszyn_kap
Commit: f8e9eaba1a195ebcaab902f100df1edc8534b421 (28 of its 46 photos, those under about 4 MB)

Modified: poses and points by COLMAP (pycolmap 4.2.1); photos undistorted to a PINHOLE camera,
resized to 800 px and then to 400 px (scikit-image, anti-aliased) and stored as JPEG of quality 90
without EXIF; every eighth observation of each track kept, and at least one. All 28 photos and all
20329 points are in the model. Made by make_boruszyn.py, beside this folder.
"""


def scale_camera(camera: pycolmap.Camera) -> None:
    """Scale a camera to the size of the bundled photos."""
    scale = LONG_SIDE / max(camera.width, camera.height)
    camera.rescale(round(camera.width * scale), round(camera.height * scale))


def thin_tracks(source: pycolmap.Reconstruction) -> dict[int, list[tuple[int, int]]]:
    """Return the kept pairs (image id, observation) for each point id."""
    kept = {}
    for point_id, point in sorted(source.points3D.items()):
        elements = sorted((e.image_id, e.point2D_idx) for e in point.track.elements)
        # Start each track at another photo, so that all photos keep equal shares of their
        # observations.
        kept[point_id] = elements[point_id % min(len(elements), KEPT_SHARE) :: KEPT_SHARE]
    return kept


def make_model(source: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Return the scaled model with thinned tracks."""
    target = pycolmap.Reconstruction()
    old_width = {camera_id: camera.width for camera_id, camera in source.cameras.items()}
    for camera in source.cameras.values():
        scale_camera(camera)
        target.add_camera_with_trivial_rig(camera)
    kept = thin_tracks(source)
    rows: dict[int, list[int]] = {image_id: [] for image_id in source.reg_image_ids()}
    tracks: dict[int, pycolmap.Track] = {}
    for point_id, elements in kept.items():
        tracks[point_id] = pycolmap.Track()
        for image_id, row in elements:
            tracks[point_id].add_element(image_id, len(rows[image_id]))
            rows[image_id].append(row)
    for image_id, wanted in sorted(rows.items()):
        old = source.images[image_id]
        scale = source.cameras[old.camera_id].width / old_width[old.camera_id]
        pixels = np.array([old.points2D[row].xy for row in wanted]).reshape(-1, 2) * scale
        new = pycolmap.Image(
            name=old.name, keypoints=pixels, camera_id=old.camera_id, image_id=image_id
        )
        target.add_image_with_trivial_frame(new, old.cam_from_world())
    for point_id, track in tracks.items():
        point = source.points3D[point_id]
        target.add_point3D(point.xyz, track, point.color)
    target.update_point_3d_errors()
    return target


def main(source: Path, target: Path) -> None:
    """Write the bundled scene."""
    model = make_model(pycolmap.Reconstruction(source / "sparse" / "0"))
    (target / "images").mkdir(parents=True, exist_ok=True)
    (target / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    for image in model.images.values():
        with Image.open(source / "images" / image.name) as file:
            photo = resize(np.array(file.convert("RGB")), image.camera.width, image.camera.height)
        path = target / "images" / image.name
        Image.fromarray(photo).save(path, quality=QUALITY, optimize=True, progressive=True)
    model.write_binary(target / "sparse" / "0")
    # Delete the rigs and frames, because they contain no information besides cameras and images of
    # single cameras.
    for name in ("rigs.bin", "frames.bin"):
        (target / "sparse" / "0" / name).unlink(missing_ok=True)
    (target / "README.txt").write_text(README, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
