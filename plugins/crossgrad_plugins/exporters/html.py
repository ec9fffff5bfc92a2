"""One HTML page that shows the Gaussians in any browser, without a network or a library."""

import json
import zlib
from base64 import b64encode
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, JACOBIAN_MARGIN
from crossgrad_core.plugin import (
    Camera,
    ExportContent,
    Exporter,
    Gaussians,
    Response,
    Similarity,
    UserError,
    atomic_file,
)
from crossgrad_plugins.exporters.ply_cloud import SplatCloud

#: Rules of drawing that a rasterizer has as options; the page uses their defaults.
NEAR, DILATION, MAX_ALPHA = 1e-3, 0.3, 0.99
#: The page holds all data in one text, and browsers limit a text to 512 MiB.
MOST_GAUSSIANS: Final = 4_000_000
_UNSIGNED, _SIGNED, _BYTE = 2**16 - 1, 2**15 - 1, 2**7 - 1
_LARGEST_HALF = float(np.finfo(np.float16).max)
#: Bytes of a texel of the texture with spherical harmonics; each degree needs one texel more.
#: Degrees 1, 2 and 3 have 3, 8 and 15 coefficients per channel, in 1, 2 and 4 groups of four.
_TEXEL, _FULL = 16, 3
#: Bytes of a Gaussian of degree 3 in the page: 84 bytes in base 64, without compression.
LARGEST_BYTES: Final = 112
#: Bytes for the facts about the scene and the headers of the compressed data, without cameras.
_LARGEST_FACTS: Final = 4096


@dataclass(frozen=True, eq=False)
class QuantisedCloud:
    """N Gaussians as integers, in the arrays that the page loads into textures.

    Attributes:
        means: [N, 3] float32, local frame.
        harmonics: [N, 16 d] int8 for degree d: coefficients of the bands 1 to d in units of 1/127
            of a range. Four coefficients of red are followed by the same four of green and of blue,
            then by the next four of red; the rest is zero.
        scales: [N, 4] uint16, natural logarithms of the three standard deviations within
            `scale_range`, and the range of `harmonics` as the bits of a half float.
        quats: [N, 4] int16, unit quaternions wxyz times 32767.
        colors: [N, 4] uint16, band 0 within `color_range` (RGB), and opacity within 0 and 1.
        degree: The highest degree with a non-zero coefficient.
        scale_range: Smallest and largest logarithm.
        color_range: Smallest and largest coefficient of band 0.
        antialiased: True for the response `antialiased`, False for `plain`.
        dilation: Dilation in px^2; None for the default.
    """

    means: NDArray[np.float32]
    harmonics: NDArray[np.int8]
    scales: NDArray[np.uint16]
    quats: NDArray[np.int16]
    colors: NDArray[np.uint16]
    degree: int
    scale_range: tuple[float, float]
    color_range: tuple[float, float]
    antialiased: bool
    dilation: float | None

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> "QuantisedCloud":
        """Quantise Gaussians, at least one; values that are not finite stay out of the ranges."""
        cloud = SplatCloud.from_gaussians(gaussians)
        scale_range, color_range = _range(cloud.log_scales), _range(cloud.sh_dc)
        lengths = np.linalg.norm(cloud.quats, axis=1, keepdims=True)
        units = cloud.quats / np.where(lengths > 0, lengths, 1)
        opacities = gaussians.opacities.detach().cpu().numpy().reshape(-1, 1)
        harmonics, ranges = _packed(cloud.sh_rest, cloud.sh_degree)
        scales = [_unsigned(cloud.log_scales, scale_range), ranges.view("<u2")]
        colors = [_unsigned(cloud.sh_dc, color_range), _unsigned(opacities, (0.0, 1.0))]
        return cls(
            means=cloud.means.astype("<f4"),
            harmonics=harmonics,
            scales=np.concatenate(scales, 1),
            quats=_rounded(units * _SIGNED).astype("<i2"),
            colors=np.concatenate(colors, 1),
            degree=cloud.sh_degree,
            scale_range=scale_range,
            color_range=color_range,
            antialiased=gaussians.response == "antialiased",
            dilation=gaussians.dilation,
        )

    def to_gaussians(self) -> Gaussians:
        """Return the Gaussians that the page draws, float32 on the CPU."""
        colors = _real(self.colors[:, :3], self.color_range)
        rest = _unpacked(self.harmonics, self.scales[:, 3:], self.degree) if self.degree else None
        return Gaussians(
            means=torch.from_numpy(self.means.copy()),
            quats=torch.from_numpy(self.quats.astype(np.float32) / _SIGNED),
            scales=torch.from_numpy(np.exp(_real(self.scales[:, :3], self.scale_range))),
            opacities=torch.from_numpy(_real(self.colors[:, 3], (0.0, 1.0))),
            sh_dc=torch.from_numpy(colors[:, None]),
            sh_rest=None if rest is None else torch.from_numpy(rest),
            sh_degree=self.degree,
            response="antialiased" if self.antialiased else "plain",
            dilation=self.dilation,
        )

    def packed(self) -> bytes:
        """Return one zlib stream of all arrays, in the order in which the page reads them."""
        arrays = (self.means, self.harmonics, self.scales, self.quats, self.colors)
        # These bytes hardly repeat, so a search for repetitions only doubles the time.
        packer = zlib.compressobj(strategy=zlib.Z_HUFFMAN_ONLY)
        return b"".join([*(packer.compress(array.tobytes()) for array in arrays), packer.flush()])


class Html(Exporter):
    """One HTML page with a viewer: a double click shows the scene, without a network."""

    suffix: ClassVar[str] = "html"
    lossy: ClassVar[bool] = True
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased"})
    keeps_response: ClassVar[bool] = True

    @override
    def largest_size(self, gaussians: int) -> int:
        return len(_template()) + _LARGEST_FACTS + gaussians * LARGEST_BYTES

    @override
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        number = len(content.gaussians)
        if not 0 < number <= MOST_GAUSSIANS:
            raise UserError(
                "an HTML page cannot show this number of Gaussians",
                where=path,
                expected=f"1 to {MOST_GAUSSIANS:,} Gaussians",
                found=f"{number:,}",
                todo="export fewer Gaussians, or choose another --format",
            )
        cloud = QuantisedCloud.from_gaussians(content.gaussians)
        head, _, rest = _template().partition(b"@TITLE@")
        middle, _, rest = rest.partition(b"@SCENE@")
        before, _, after = rest.partition(b"@DATA@")
        title, facts = escape(content.name).encode(), _script_json(_facts(content, cloud))
        with atomic_file(path) as file:
            file.writelines((head, title, middle, facts, before, b64encode(cloud.packed()), after))
        return ()

    @override
    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        return QuantisedCloud.from_gaussians(gaussians).to_gaussians()


def _facts(content: ExportContent, cloud: QuantisedCloud) -> dict[str, Any]:
    """Return what the page knows in addition to the arrays."""
    up = (0.0, -1.0, 0.0) if content.up is None else content.up.tolist()
    cameras = [_camera(v.camera, v.name, v.regime) for v in content.views] or [_overview(cloud)]
    return {
        "gaussians": len(cloud.means),
        "degree": cloud.degree,
        "scale_range": cloud.scale_range,
        "color_range": cloud.color_range,
        "antialiased": cloud.antialiased,
        "dilation": DILATION if cloud.dilation is None else cloud.dilation,
        "near": NEAR,
        "max_alpha": MAX_ALPHA,
        "threshold": ALPHA_THRESHOLD,
        "margin": JACOBIAN_MARGIN,
        "offset": content.similarity.offset.tolist(),
        "scale": content.similarity.scale,
        "up": up,
        "comments": list(content.comments),
        "cameras": cameras,
    }


def _camera(camera: Camera, name: str, regime: str) -> dict[str, Any]:
    lens = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    pose = camera.world_to_camera[:3].tolist()
    return {"name": name, "regime": regime, **lens, "world_to_camera": pose}


def _overview(cloud: QuantisedCloud) -> dict[str, Any]:
    """Return a camera that sees most Gaussians, for a scene without cameras."""
    middle = np.median(cloud.means, axis=0)
    extent = float(np.quantile(np.linalg.norm(cloud.means - middle, axis=1), 0.9)) or 1.0
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.from_numpy(-middle.astype(np.float64))
    pose[2, 3] += 3.0 * extent
    return _camera(Camera(1280, 720, 1000.0, 1000.0, 640.0, 360.0, pose), "overview", "")


def _template() -> bytes:
    return files(__package__).joinpath("viewer.html").read_bytes()


def _script_json(value: object) -> bytes:
    """Return JSON for a script element: no text inside can end the element or open a comment."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c").encode()


def _range(values: NDArray[np.float32]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)


def _rounded(values: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.rint(np.nan_to_num(values)))


def _unsigned(values: NDArray[Any], between: tuple[float, float]) -> NDArray[np.uint16]:
    low, high = between
    shares = np.clip((values - low) / ((high - low) or 1.0), 0.0, 1.0)
    return _rounded(shares * _UNSIGNED).astype("<u2")


def _real(stored: NDArray[np.uint16], between: tuple[float, float]) -> NDArray[np.float32]:
    low, high = between
    return (low + stored.astype(np.float64) / _UNSIGNED * (high - low)).astype(np.float32)


def _packed(rest: NDArray[np.float32], degree: int) -> tuple[NDArray[np.int8], NDArray[np.float16]]:
    """Return `harmonics` [N, 16 d] and their ranges [N, 1] of bands 1 to d of `rest` [N, 15, 3]."""
    number, bands = len(rest), (degree + 1) ** 2 - 1
    values = np.zeros((number, 4 * (degree + degree // _FULL), 3), dtype=np.float32)
    values[:, :bands] = np.clip(np.nan_to_num(rest[:, :bands]), -_LARGEST_HALF, _LARGEST_HALF)
    # The range is 1 unless a coefficient is larger, so that most bytes are small and compress well.
    largest = np.maximum(np.abs(values).max(axis=(1, 2), initial=0.0), 1.0)
    ranges = largest.astype("<f2")
    ranges = np.where(ranges < largest, np.nextafter(ranges, np.float16(np.inf)), ranges)
    steps = np.rint(values * (_BYTE / ranges.astype(np.float32))[:, None, None])
    words = steps.astype(np.int8).reshape(number, -1, 4, 3).swapaxes(2, 3).reshape(number, -1)
    table = np.zeros((number, _TEXEL * degree), dtype=np.int8)
    table[:, : words.shape[1]] = words
    return table, ranges[:, None]


def _unpacked(
    table: NDArray[np.int8], ranges: NDArray[np.uint16], degree: int
) -> NDArray[np.float32]:
    words = table[:, : 12 * (degree + degree // _FULL)].reshape(len(table), -1, 3, 4)
    steps = words.swapaxes(2, 3).reshape(len(table), -1, 3)[:, : (degree + 1) ** 2 - 1]
    units = np.ascontiguousarray(ranges).view("<f2").astype(np.float32)[:, :, None] / _BYTE
    return np.asarray(steps * units, dtype=np.float32)
