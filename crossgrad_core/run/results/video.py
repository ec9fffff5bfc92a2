"""Functions that write frames as image files and as a video."""

import io
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from torch import Tensor

from crossgrad_core.contract.scene import to_uint8
from crossgrad_core.errors import UserError
from crossgrad_core.system.files import atomic_file, disk_errors, write_atomically
from crossgrad_core.system.interrupts import HELPERS

#: The program that writes videos. If the program is missing, Pillow writes an animated image.
ENCODER: Final = "ffmpeg"
_QUALITY: Final = 85
#: Maximum total size of the frames of an animated image in bytes. All frames are in memory at the
#: same time.
_LARGEST: Final = 1 << 29
#: Maximum side of an animated image in pixels.
_LONGEST: Final = 16_383


def write_frames(images: Iterable[Tensor], folder: Path) -> list[Path]:
    """Write the images as `00000.png` and so on; return the files in order.

    Args:
        images: Images [H, W, 3] float; the values need not be clamped.
        folder: The folder of the images, which is created if it does not exist.

    Raises:
        UserError: The disk is full.
    """
    from PIL import Image

    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    files = []
    for number, image in enumerate(images):
        picture = io.BytesIO()
        Image.fromarray(to_uint8(image).cpu().numpy()).save(picture, format="png")
        files.append(folder / f"{number:05d}.png")
        write_atomically(files[-1], picture.getvalue())
    return files


def drop_frames(folder: Path, count: int) -> None:
    """Remove the frames from number `count` on, which belong to an earlier, longer video."""
    number = count
    while (frame := folder / f"{number:05d}.png").is_file():
        frame.unlink()
        number += 1


def video_files(folder: Path) -> tuple[Path, Path]:
    """Return the paths of a video by ffmpeg and of a video by Pillow in a folder of frames."""
    return folder / "video.mp4", folder / "video.webp"


def write_video(frames: list[Path], fps: float) -> Path | None:
    """Write the frames as video.mp4 if ffmpeg is installed, else as video.webp; return the file.

    Without ffmpeg, write no video and return None if there are too many or too large frames.

    Args:
        frames: PNG files named by their numbers from 0 on, in one folder.
        fps: Frames per second.

    Raises:
        UserError: ffmpeg failed, or the disk is full.
    """
    encoder, (encoded, animated) = shutil.which(ENCODER), video_files(frames[0].parent)
    if encoder is None:
        return _animated(frames, animated, fps)
    with atomic_file(encoded) as file:
        _encode(encoder, frames, Path(file.name), fps)
    return encoded


def _encode(encoder: str, frames: list[Path], target: Path, fps: float) -> None:
    # Limit the number of frames, because the folder may contain frames of an earlier, longer video.
    source = ["-framerate", f"{fps:g}", "-i", str(frames[0].parent / "%05d.png")]
    count = ["-frames:v", str(len(frames))]
    # Video players require even side lengths and the pixel format yuv420p.
    shape = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]
    command = [encoder, "-y", "-loglevel", "error", *source, *count, *shape, "-f", "mp4"]
    process = subprocess.Popen(
        [*command, str(target)], stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    HELPERS.add(process.pid)
    try:
        _, said = process.communicate()
    finally:
        HELPERS.discard(process.pid)
    if process.returncode != 0:
        raise UserError(
            "the video could not be written",
            where=frames[0].parent,
            found=said.strip()[-300:],
            todo="the frames are in the folder",
        )


def _animated(frames: list[Path], path: Path, fps: float) -> Path | None:
    from PIL import Image

    with Image.open(frames[0]) as image:
        size, longest = 3 * image.width * image.height, max(image.size)
    if size * len(frames) > _LARGEST or longest > _LONGEST:
        return None
    images = []
    for frame in frames:  # Pillow requires all frames in memory.
        with Image.open(frame) as image:
            images.append(image.copy())
    with atomic_file(path) as file:
        images[0].save(
            file, format="webp", save_all=True, append_images=images[1:],
            duration=round(1000 / fps), loop=0, quality=_QUALITY,
        )  # fmt: skip
    return path
