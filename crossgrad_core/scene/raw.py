"""The raw scene: a reader's findings before split, resizing and the local frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.calibration import Calibration


@dataclass(frozen=True, eq=False)
class RawView:
    """A posed photo as the input describes it.

    Attributes:
        name: Path below the image folder with forward slashes; unique.
        calibration: Camera model, before undistortion and resizing.
        world_to_camera: [4, 4] float64, rigid, input frame to camera frame (OpenCV axes).
        seen: [S] int64 rows of the scene's points that the view observed; may be empty.
        mask: Its mask where the input names it; an option for the mask folder comes first.
        place: Path whose folders tell the regime; None for the name's own folders.
    """

    name: str
    calibration: Calibration
    world_to_camera: NDArray[np.float64]
    seen: NDArray[np.int64]
    mask: Path | None = None
    place: str | None = None


@dataclass(frozen=True, eq=False)
class RawScene:
    """A scene as the input describes it; `crossgrad_core.scene.build` turns it into a `Scene`.

    Attributes:
        root: The scene's folder: split lists and the default mask folder are looked for in it, and
            it gives the scene its name.
        images: The folder of the photos; the siblings `<images>_2`, `_4` and `_8` may hold smaller
            copies.
        views: The posed photos, in any order.
        points: [P, 3] float64 SfM points, input frame; may be empty.
        point_colors: [P, 3] uint8 RGB.
        notes: What the reader did to the input.
        split: Names of the training and of the test views where the input itself prescribes them.
        background: RGB in [0, 1] to put behind photos with an alpha channel; None where pixels with
            alpha below a half do not count.
        files: Files that the reader used, except photos and masks.
    """

    root: Path
    images: Path
    views: tuple[RawView, ...]
    points: NDArray[np.float64]
    point_colors: NDArray[np.uint8]
    notes: tuple[str, ...] = ()
    split: tuple[frozenset[str], frozenset[str]] | None = None
    background: tuple[float, float, float] | None = None
    files: tuple[Path, ...] = ()
