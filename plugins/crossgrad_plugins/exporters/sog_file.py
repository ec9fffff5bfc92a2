"""SOG files, version 2: Gaussians as lossless WebP images in a ZIP archive.

Source: the specification of PlayCanvas (developer.playcanvas.com, "The SOG Format"). Pixel i of
each image belongs to Gaussian i. Sizes and colours are entries of codebooks with 256 values.
Spherical harmonics above band 0 are entries of a palette of at most 65,536 rows.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from math import ceil, sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from crossgrad_core.numerics.raster_constants import COEFFICIENTS
from crossgrad_core.plugin import UserError, open_file
from crossgrad_plugins.exporters.palette import codebook_of, nearest_entry, palette_of
from crossgrad_plugins.exporters.ply_cloud import REST, SplatCloud
from crossgrad_plugins.exporters.ply_file import check_coordinates

Bytes = NDArray[np.uint8]

VERSION: Final = 2
#: Palette entries in one row of the image of centroids.
_ACROSS: Final = 64
#: Value of the alpha channel for rotations whose largest component is w.
_MODE: Final = 252
_STEPS: Final = 65_535
_OFFSET: Final = "crossgrad_offset"
_OPACITY_MARGIN: Final = 2.0**-24
#: All files of an archive have this time, so that equal Gaussians give equal bytes.
_TIME: Final = (1980, 1, 1, 0, 0, 0)
#: Largest number of bytes of an image, so that a damaged archive cannot fill the memory.
_MOST: Final = 1 << 30


def packed(cloud: SplatCloud, offset: NDArray[np.float64], comments: Sequence[str] = ()) -> bytes:
    """Return the content of a SOG file.

    Args:
        cloud: Finite Gaussians in the units of the file, at least one.
        offset: [3] added to the positions to get coordinates of the file. Other programs ignore it.
        comments: Lines of plain text about the file.
    """
    means = np.sign(cloud.means) * np.log1p(np.abs(cloud.means))
    low, high = means.min(axis=0), means.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    levels = np.round((means - low) / span * _STEPS).astype(np.uint16)
    scales, colors = codebook_of(cloud.log_scales), codebook_of(cloud.sh_dc)
    opacities = np.round(255 / (1 + np.exp(-cloud.logit_opacities.astype(np.float64))))
    images = {
        "means_l": (levels & 255).astype(np.uint8),
        "means_u": (levels >> 8).astype(np.uint8),
        "quats": _smallest_three(cloud.quats),
        "scales": nearest_entry(cloud.log_scales, scales),
        "sh0": np.concatenate(
            [nearest_entry(cloud.sh_dc, colors), opacities.astype(np.uint8)[:, None]], axis=1
        ),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "count": len(cloud),
        "antialias": cloud.render_mode == "mip",
        "asset": {"generator": "crossgrad", "comments": list(comments)},
        "means": {"mins": low.tolist(), "maxs": high.tolist(), **_files("means_l", "means_u")},
        "scales": {"codebook": scales.tolist(), **_files("scales")},
        "quats": _files("quats"),
        "sh0": {"codebook": colors.tolist(), **_files("sh0")},
    }
    if offset.any():
        meta[_OFFSET] = offset.tolist()
    pictures = {name: _square(pixels) for name, pixels in images.items()}
    if cloud.sh_degree:
        used = COEFFICIENTS[cloud.sh_degree] - 1
        rows = cloud.sh_rest[:, :used].transpose(0, 2, 1).reshape(len(cloud), -1)
        centroids, labels = palette_of(rows)
        values = codebook_of(centroids)
        entries = nearest_entry(centroids, values).reshape(-1, 3, used).transpose(0, 2, 1)
        pictures["shN_centroids"] = _palette_image(entries)
        pictures["shN_labels"] = _square(
            np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
        )
        meta["shN"] = {
            "count": len(centroids),
            "bands": cloud.sh_degree,
            "codebook": values.tolist(),
            **_files("shN_centroids", "shN_labels"),
        }
    return _archive(meta, pictures)


def unpacked(content: bytes, path: Path) -> SplatCloud:
    """Return the Gaussians of a SOG file, in the coordinates of the file.

    Args:
        content: The bytes of the file.
        path: The file, for messages.

    Raises:
        UserError: The content is not a SOG file of version 2, it is damaged, or it has other
            coordinates than the scene's input.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            meta = _meta(archive)
            asset = meta.get("asset")
            comments = asset.get("comments", []) if isinstance(asset, dict) else []
            cloud = _cloud(meta, archive)
    except _DAMAGES as error:
        raise _malformed(path, " ".join(f"{type(error).__name__}: {error}".split())) from error
    check_coordinates([str(line) for line in comments], path)
    return cloud


def bands_of(path: Path) -> int:
    """Return the SH degree that the meta.json of a SOG file gives.

    Raises:
        UserError: The file is not a SOG file.
    """
    try:
        with open_file(path) as file, zipfile.ZipFile(file) as archive:
            return _bands(_meta(archive))
    except _DAMAGES as error:
        raise _malformed(path, " ".join(f"{type(error).__name__}: {error}".split())) from error


_DAMAGES: Final = (
    *(ArithmeticError, EOFError, LookupError, NotImplementedError, OSError, RuntimeError),
    *(TypeError, ValueError, zipfile.BadZipFile, zlib.error, Image.DecompressionBombError),
)


def _malformed(path: Path, found: str) -> UserError:
    return UserError(
        "the SOG file cannot be read",
        where=path,
        expected="a ZIP archive with meta.json of version 2 and its images",
        found=found,
        todo="copy, download or export the file again",
    )


def _cloud(meta: Mapping[str, Any], archive: zipfile.ZipFile) -> SplatCloud:
    count = int(meta["count"])
    if not 0 < count <= _MOST:
        raise ValueError(f"{count} Gaussians")
    lower, upper = (_pixels(archive, name, count) for name in meta["means"]["files"])
    levels = lower[:, :3].astype(np.float64) + 256.0 * upper[:, :3]
    low, high = (_numbers(meta["means"][name], 3) for name in ("mins", "maxs"))
    logs = low + (high - low) * levels / _STEPS
    offset = _numbers(meta.get(_OFFSET, [0.0] * 3), 3)
    sizes = _pixels(archive, meta["scales"]["files"][0], count)[:, :3]
    base = _pixels(archive, meta["sh0"]["files"][0], count)
    opacity = np.clip(base[:, 3] / 255.0, _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
    cloud = SplatCloud(
        means=np.sign(logs) * np.expm1(np.abs(logs)) + offset,
        log_scales=_numbers(meta["scales"]["codebook"], 256)[sizes].astype(np.float32),
        quats=_from_smallest_three(_pixels(archive, meta["quats"]["files"][0], count)),
        logit_opacities=(np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        sh_dc=_numbers(meta["sh0"]["codebook"], 256)[base[:, :3]].astype(np.float32),
        sh_rest=_harmonics(meta, archive, count),
        render_mode="mip" if meta.get("antialias") else "default",
    )
    if not (np.isfinite(cloud.means).all() and np.abs(cloud.log_scales).max() <= _LARGEST_LOG):
        raise ValueError("positions or sizes outside the range of float32")
    return cloud


#: Largest natural logarithm of a size.
_LARGEST_LOG: Final = 80.0


def _harmonics(
    meta: Mapping[str, Any], archive: zipfile.ZipFile, count: int
) -> NDArray[np.float32]:
    rest = np.zeros((count, REST, 3), dtype=np.float32)
    degree = _bands(meta)
    if not degree:
        return rest
    part, used = meta["shN"], COEFFICIENTS[degree] - 1
    centroids, labels = part["files"]
    size = int(part["count"])
    image = _image(archive, centroids)[..., :3]
    entries = image.reshape(-1, used, 3)[:size]
    index = _pixels(archive, labels, count).astype(np.int64)
    index = index[:, 0] + 256 * index[:, 1]
    if image.shape[1] != _ACROSS * used or index.max() >= len(entries):
        raise ValueError("the palette of spherical harmonics is too small")
    values = _numbers(part["codebook"], 256)[entries].astype(np.float32)
    rest[:, :used] = values[index]
    return rest


def _meta(archive: zipfile.ZipFile) -> dict[str, Any]:
    meta = json.loads(_member(archive, "meta.json"))
    if not isinstance(meta, dict) or meta.get("version") != VERSION:
        raise ValueError(f"meta.json is not of version {VERSION}")
    return meta


def _bands(meta: Mapping[str, Any]) -> int:
    degree = int(meta["shN"]["bands"]) if "shN" in meta else 0
    if degree not in range(4):
        raise ValueError(f"{degree} bands of spherical harmonics")
    return degree


def _numbers(values: object, count: int) -> NDArray[np.float64]:
    numbers = np.array(values, dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"a list that is not {count} finite numbers")
    return numbers


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    if archive.getinfo(name).file_size > _MOST:
        raise ValueError(f"{name} is too large")
    return archive.read(name)


def _image(archive: zipfile.ZipFile, name: str) -> Bytes:
    with Image.open(io.BytesIO(_member(archive, name))) as image:
        return np.asarray(image.convert("RGBA"))


def _pixels(archive: zipfile.ZipFile, name: str, count: int) -> Bytes:
    """Return [count, 4] the first pixels of an image."""
    pixels = _image(archive, name).reshape(-1, 4)[:count]
    if len(pixels) < count:
        raise ValueError(f"{name} has {len(pixels)} of {count} pixels")
    return pixels


def _smallest_three(quats: NDArray[np.float32]) -> Bytes:
    """Return [N, 4] three components of the rotations wxyz, and which one is left out."""
    units = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-30)
    largest = np.abs(units).argmax(axis=1)
    rows = np.arange(len(units))
    units = units * np.where(units[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    kept = units[rows[:, None], others]
    levels = np.clip(np.round((kept * sqrt(0.5) + 0.5) * 255), 0, 255)
    return np.concatenate([levels, _MODE + largest[:, None]], axis=1).astype(np.uint8)


def _from_smallest_three(pixels: Bytes) -> NDArray[np.float32]:
    kept = (pixels[:, :3] / 255.0 - 0.5) * sqrt(2.0)
    omitted = np.sqrt(np.maximum(0.0, 1.0 - (kept**2).sum(axis=1)))
    mode = pixels[:, 3].astype(np.int64) - _MODE
    if mode.min() < 0:
        raise ValueError("a rotation without a mode")
    quats = np.empty((len(pixels), 4), dtype=np.float32)
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[mode]
    rows = np.arange(len(pixels))
    quats[rows[:, None], others] = kept
    quats[rows, mode] = omitted
    return quats


def _files(*names: str) -> dict[str, list[str]]:
    return {"files": [f"{name}.webp" for name in names]}


def _square(pixels: Bytes) -> Bytes:
    """Return [H, W, C] an image with one pixel per row of `pixels` [N, C]; the rest is zero."""
    width = 4 * ceil(sqrt(len(pixels)) / 4)
    height = ceil(len(pixels) / width)
    image = np.zeros((height * width, pixels.shape[1]), dtype=np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, -1)


def _palette_image(entries: Bytes) -> Bytes:
    """Return [H, 64 B, 3] an image with 64 entries [B, 3] per row."""
    count, used, _ = entries.shape
    image = np.zeros((_ACROSS * ceil(count / _ACROSS), used, 3), dtype=np.uint8)
    image[:count] = entries
    return image.reshape(-1, _ACROSS * used, 3)


def _archive(meta: Mapping[str, Any], images: Mapping[str, Bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        for name, pixels in images.items():
            encoded = io.BytesIO()
            # `exact` keeps the colours of pixels whose alpha is 0.
            Image.fromarray(pixels).save(encoded, "webp", lossless=True, exact=True, method=2)
            archive.writestr(zipfile.ZipInfo(f"{name}.webp", _TIME), encoded.getvalue())
        archive.writestr(zipfile.ZipInfo("meta.json", _TIME), json.dumps(meta))
    return content.getvalue()
