"""Photos, masks and model without lens distortion, as `crossgrad run` reads them."""

import io
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_core.commands import UserError, check_folder, disk_errors, write_atomically
from crossgrad_core.scene.photos.decode import decode_photo
from crossgrad_plugins.prepare.layout import Layout, emptied, scratch_of
from crossgrad_plugins.prepare.masks import HALF, counting_pixels
from crossgrad_plugins.prepare.plan import Plan
from crossgrad_plugins.prepare.pycolmap_calls import check_written, quiet, waited

if TYPE_CHECKING:
    import pycolmap

#: Number of photos that are undistorted between two checks for cancellation.
_BATCH: Final = 32
_QUALITY: Final = 95
#: Estimated number of bytes per pixel of a written photo, and of all other files except the model.
#: A sharp JPEG photo of this quality needs 0.4 bytes per pixel; an image of pure noise needs 2.
_BYTES_PER_PIXEL, _BESIDE = 1.0, 2**18


def write_scene(layout: Layout, plan: Plan, threads: int) -> None:
    """Write the undistorted photos and masks, and then the model.

    Raises:
        UserError: The disk is full, or pycolmap failed.
    """
    if layout.model.is_dir():
        return
    import pycolmap

    with quiet():
        model = pycolmap.Reconstruction(layout.placed)
    images = [model.image(number) for number in model.reg_image_ids()]
    names = sorted(image.name for image in images)
    work = scratch_of(layout.undistorted)
    done = [name for name in names if (layout.images / name).is_file()]
    left = [name for name in names if name not in set(done)]
    for start in range(0, max(1, len(left)), _BATCH):
        batch = left[start : start + _BATCH] or names[:1]
        check_folder(layout.scene, _room(layout, plan, model, batch))
        _undistort(layout, plan, batch, threads, f"{len(done) + start} of {len(names)} photos")
        for name in batch:
            _moved(work / "images" / name, layout.images / name)
    _write_masks(layout, plan, model)
    layout.model.parent.mkdir(exist_ok=True)
    check_written(work / "sparse")
    with disk_errors(layout.model):
        (work / "sparse").replace(layout.model)
    shutil.rmtree(work)


def _room(
    layout: Layout, plan: Plan, model: "pycolmap.Reconstruction", names: Sequence[str]
) -> int:
    """Return the free bytes that are needed for these undistorted photos and the model.

    They are checked in advance, because the JPEG writer aborts the process on a full disk.
    """
    import pycolmap

    room = sum(path.stat().st_size for path in layout.placed.iterdir()) + _BESIDE
    for name in names:
        image = model.find_image_with_name(name)
        camera = pycolmap.undistort_camera(_options(plan), model.camera(image.camera_id))
        room += int(_BYTES_PER_PIXEL * camera.width * camera.height)
    return room


def _undistort(layout: Layout, plan: Plan, names: Sequence[str], threads: int, far: str) -> None:
    """Write some photos and the whole model to the scratch folder."""
    import pycolmap

    work = emptied(scratch_of(layout.undistorted))
    waited(
        "undistorting photos",
        lambda token: pycolmap.undistort_images(
            work, layout.placed, Path(plan.photos), list(names), undistort_options=_options(plan),
            jpeg_quality=_QUALITY, num_threads=threads, cancellation_token=token,
        ),
        lambda: far,
    )  # fmt: skip


def _options(plan: Plan) -> "pycolmap.UndistortCameraOptions":
    import pycolmap

    options = pycolmap.UndistortCameraOptions()
    if plan.settings.max_size is not None:
        options.max_image_size = plan.settings.max_size
    return options


def _moved(here: Path, there: Path) -> None:
    if not _is_written(here):  # pycolmap does not report why a file is missing.
        raise UserError(
            "an undistorted photo could not be written",
            where=there,
            todo="check that the disk has room, and run the same command again",
        )
    with disk_errors(there):
        there.parent.mkdir(parents=True, exist_ok=True)
        here.replace(there)


def _is_written(photo: Path) -> bool:
    """Return True if the file of a photo exists and is complete."""
    # The JPEG writer aborts the process if it cannot write, so an existing JPEG file is complete.
    # Files in other formats may be truncated.
    if not photo.is_file() or photo.suffix.lower() in {".jpg", ".jpeg"}:
        return photo.is_file()
    try:
        decode_photo(photo)
    except UserError:
        return False
    return True


def _write_masks(layout: Layout, plan: Plan, model: "pycolmap.Reconstruction") -> None:
    """Write the undistorted masks of photos with a mask or with transparent pixels."""
    import pycolmap
    from PIL import Image

    photos = {photo.name: photo for photo in plan.used}
    for number in model.reg_image_ids():
        image = model.image(number)
        path = layout.masks / f"{image.name}.png"
        if path.is_file():
            continue
        counting = counting_pixels(Path(plan.photos), photos[image.name])
        if counting is None:
            continue
        with quiet():
            bitmap = pycolmap.Bitmap.from_array(counting)
            bitmap, _ = pycolmap.undistort_image(
                _options(plan), bitmap, model.camera(image.camera_id)
            )
        kept = np.where(bitmap.to_array() >= HALF, 255, 0).astype(np.uint8)
        content = io.BytesIO()
        Image.fromarray(kept).save(content, format="PNG")
        with disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content.getvalue())
