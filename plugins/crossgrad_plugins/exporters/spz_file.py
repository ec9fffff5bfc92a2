"""SPZ files, versions 2 and 3: Gaussians as integers, one stream of gzip.

Source: the format of Niantic (github.com/nianticlabs/spz, MIT). A header of 16 bytes is followed by
one table per field: positions in fixed point of 24 bits, opacities, colours, logarithms of sizes,
rotations and spherical harmonics. The bands of a Gaussian are coefficient by coefficient, RGB.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import floor, log2, sqrt
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import COEFFICIENTS
from crossgrad_core.plugin import UserError
from crossgrad_plugins.exporters.file_units import bytes_of
from crossgrad_plugins.exporters.ply_cloud import REST, SplatCloud

Bytes = NDArray[np.uint8]

VERSIONS: Final = (2, 3)
_MAGIC: Final = b"NGSP"
_HEADER: Final = struct.Struct("<4sIIBBBB")
_ANTIALIASED: Final = 1
_LARGEST: Final = 2**23 - 1
#: Largest number of binary digits after the point; with it a unit has a million steps.
_FINEST: Final = 20
_COLOR_STEPS: Final = 0.15 * 255
_SCALE_STEPS, _SCALE_START = 16.0, 10.0
_SH_STEPS: Final = 128.0
#: Steps of spherical harmonics that are merged into one: 5 bits of band 1, and 4 of the others are
#: left. Viewers read all 8 bits, but the files of most writers have these.
_FIRST_BAND, _STEP_FIRST, _STEP_REST = 3, 8, 16
_THREE_STEPS: Final = 511 * sqrt(2)
_CHUNK: Final = 65_536
#: Higher levels of zlib need twice the time for 3 % fewer bytes.
_LEVEL: Final = 4
#: Most bytes of an uncompressed table, so that a damaged file cannot fill the memory.
_MOST: Final = 4 << 30
_OPACITY_MARGIN: Final = 2.0**-24


@dataclass(frozen=True, eq=False)
class SpzTable:
    """N Gaussians as the integers of a file.

    Attributes:
        version: 2 or 3.
        degree: Degree of spherical harmonics, 0 to 3.
        fractional_bits: Binary digits of positions after the point.
        antialiased: The flag for viewers that antialias as Mip-Splatting does.
        positions: [N, 9] the bytes of three little-endian integers of 24 bits.
        opacities: [N], 255 for 1.
        colors: [N, 3] band 0 of the spherical harmonics.
        scales: [N, 3] logarithms.
        rotations: [N, 3] in version 2, else [N, 4].
        harmonics: [N, 3 B] bands 1 to `degree` with B coefficients.
    """

    version: int
    degree: int
    fractional_bits: int
    antialiased: bool
    positions: Bytes
    opacities: Bytes
    colors: Bytes
    scales: Bytes
    rotations: Bytes
    harmonics: Bytes

    @classmethod
    def of(cls, cloud: SplatCloud, version: int) -> "SpzTable":
        """Quantise a cloud with finite values."""
        count, degree = len(cloud), cloud.sh_degree
        used = COEFFICIENTS[degree] - 1
        extent = float(np.abs(cloud.means).max(initial=0.0))
        bits = _FINEST if extent == 0.0 else floor(log2(_LARGEST / extent))
        table = cls(
            version,
            degree,
            min(max(bits, 0), _FINEST),
            cloud.render_mode == "mip",
            *(np.empty((count, n), np.uint8) for n in _widths(version, degree)),
        )
        rotations = _packed_three if version == VERSIONS[0] else _packed_smallest_three
        # Chunks of this size stay in the caches of the processor
        for start in range(0, count, _CHUNK):
            rows = slice(start, start + _CHUNK)
            table.positions[rows] = _fixed_point(cloud.means[rows], table.fractional_bits)
            with np.errstate(over="ignore"):
                opacities = 1.0 / (1.0 + np.exp(-cloud.logit_opacities[rows, None]))
            table.opacities[rows] = _rounded(opacities * 255)
            table.colors[rows] = _rounded(cloud.sh_dc[rows] * _COLOR_STEPS + 127.5)
            table.scales[rows] = _rounded((cloud.log_scales[rows] + _SCALE_START) * _SCALE_STEPS)
            table.rotations[rows] = rotations(cloud.quats[rows])
            table.harmonics[rows] = _harmonics(cloud.sh_rest[rows, :used])
        return table

    @property
    def means(self) -> NDArray[np.float64]:
        """[N, 3] centres in the units of the file."""
        return _from_fixed_point(self.positions, self.fractional_bits)

    def to_cloud(self) -> SplatCloud:
        """Return the Gaussians in the units of the file."""
        count, used = len(self.positions), COEFFICIENTS[self.degree] - 1
        rest = np.zeros((count, REST, 3), np.float32)
        rest[:, :used] = ((self.harmonics.astype(np.float32) - 128) / _SH_STEPS).reshape(
            count, used, 3
        )
        opacities = np.clip(self.opacities[:, 0] / 255.0, _OPACITY_MARGIN, 1.0 - _OPACITY_MARGIN)
        rotations = _three if self.version == VERSIONS[0] else _smallest_three
        return SplatCloud(
            means=self.means,
            log_scales=self.scales.astype(np.float32) / np.float32(_SCALE_STEPS) - _SCALE_START,
            quats=rotations(self.rotations),
            logit_opacities=np.log(opacities / (1.0 - opacities)).astype(np.float32),
            sh_dc=(self.colors.astype(np.float32) - 127.5) / np.float32(_COLOR_STEPS),
            sh_rest=rest,
            render_mode="mip" if self.antialiased else "default",
        )

    def packed(self) -> Iterator[bytes]:
        """Yield the parts of the file."""
        # A header of gzip without a time, so that equal Gaussians give equal files
        stream = zlib.compressobj(_LEVEL, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
        flags = _ANTIALIASED * self.antialiased
        count = len(self.positions)
        head = (_MAGIC, self.version, count, self.degree, self.fractional_bits, flags, 0)
        yield stream.compress(_HEADER.pack(*head))
        for table in self._tables:
            flat = table.reshape(-1)
            for start in range(0, len(flat), 16 * _CHUNK):
                yield stream.compress(flat[start : start + 16 * _CHUNK].data)
        yield stream.flush()

    @property
    def _tables(self) -> tuple[Bytes, ...]:
        """The tables in the order of the file."""
        return (
            self.positions,
            self.opacities,
            self.colors,
            self.scales,
            self.rotations,
            self.harmonics,
        )

    @classmethod
    def unpacked(cls, compressed: bytes, where: Path) -> "SpzTable":
        """Return the integers of a file.

        Args:
            compressed: The content of the file.
            where: The file, for error messages.

        Raises:
            UserError: The content is not an SPZ file of version 2 or 3, is damaged or is empty.
        """
        stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
        try:
            head = _header(stream.decompress(compressed, _HEADER.size), where)
            _, version, count, degree, bits, flags, _ = head
            widths = _widths(version, degree)
            needed = count * sum(widths)
            content = stream.decompress(stream.unconsumed_tail, needed) if needed else b""
        except zlib.error as error:
            raise _damaged(where, str(error)) from error
        if len(content) < needed:
            raise _damaged(where, f"{len(content):,} of {needed:,} bytes")
        tables, start = [], 0
        for width in widths:
            table = np.frombuffer(content, np.uint8, count * width, start)
            tables.append(table.reshape(count, width))
            start += count * width
        return cls(version, degree, bits, bool(flags & _ANTIALIASED), *tables)


def spz_degree(path: Path) -> int:
    """Return the degree of spherical harmonics that the header of a file gives.

    Raises:
        UserError: The file cannot be read, or is not an SPZ file of version 2 or 3.
    """
    start = bytes_of(path, 4096)
    try:
        head = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(start, _HEADER.size)
    except zlib.error as error:
        raise _damaged(path, str(error)) from error
    return int(_header(head, path)[3])


def _header(head: bytes, where: Path) -> tuple[Any, ...]:
    """Return the fields of a header that can be read."""
    if len(head) < _HEADER.size or head[:4] != _MAGIC:
        raise _damaged(where, "another header")
    fields = _HEADER.unpack(head)
    _, version, count, degree, bits, *_ = fields
    if version not in VERSIONS:
        raise UserError(
            "the SPZ file has a version that crossgrad does not read",
            where=where,
            expected="version 2 or 3",
            found=f"version {version}",
            todo="convert it, e.g. with splat-transform to PLY",
        )
    if degree >= len(COEFFICIENTS) or bits > 2 * _FINEST:
        raise _damaged(where, f"degree {degree}, {bits} fractional bits")
    if not 0 < count * sum(_widths(version, degree)) <= _MOST:
        raise _damaged(where, f"{count:,} Gaussians")
    return fields


def _damaged(where: Path, found: str) -> UserError:
    return UserError(
        "the file is not a complete SPZ file of Gaussians",
        where=where,
        found=found,
        todo="copy it again, or export the Gaussians again",
    )


def _widths(version: int, degree: int) -> tuple[int, ...]:
    """Return the bytes per Gaussian of each table."""
    return 9, 1, 3, 3, 3 if version == VERSIONS[0] else 4, 3 * (COEFFICIENTS[degree] - 1)


def _rounded(values: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.clip(np.rint(values), 0, 255))


def _fixed_point(means: NDArray[np.float64], bits: int) -> Bytes:
    steps = np.rint(means * 2.0**bits).clip(-_LARGEST, _LARGEST).astype("<i4")
    parts = steps.view(np.uint8).reshape(-1, 3, 4)
    return np.ascontiguousarray(parts[:, :, :3]).reshape(-1, 9)


def _from_fixed_point(table: Bytes, bits: int) -> NDArray[np.float64]:
    parts = np.zeros((len(table), 3, 4), np.uint8)
    parts[:, :, 1:] = table.reshape(-1, 3, 3)
    # The division of the shifted number by 256 extends the sign
    return parts.view("<i4")[:, :, 0] / 256.0 / 2.0**bits


def unit_quaternions(quats: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return [N, 4] unit quaternions xyzw of any quaternions wxyz."""
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    units = np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1, 0, 0, 0])
    return units[:, [1, 2, 3, 0]].astype(np.float32)


def _packed_three(quats: NDArray[np.float32]) -> Bytes:
    """Return [N, 3] bytes of x, y, z for a positive w, which the reader computes."""
    units = unit_quaternions(quats)
    units = units[:, :3] * np.where(units[:, 3:] < 0, -1, 1)
    return _rounded(units * 127.5 + 127.5).astype(np.uint8)


def _three(table: Bytes) -> NDArray[np.float32]:
    vectors = table / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(0, 1 - (vectors**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, vectors], axis=1).astype(np.float32)


def _packed_smallest_three(quats: NDArray[np.float32]) -> Bytes:
    """Return [N, 4] bytes: 2 bits name the largest number, three others have 10 bits each."""
    units = unit_quaternions(quats)
    largest = np.abs(units).argmax(axis=1)
    signs = np.take_along_axis(units, largest[:, None], axis=1) < 0
    sizes = np.minimum(np.rint(np.abs(units) * _THREE_STEPS), 511).astype(np.uint32)
    numbers = sizes | ((units < 0) ^ signs).astype(np.uint32) << 9
    packed = largest.astype(np.uint32)
    for axis in range(4):
        packed = np.where(largest == axis, packed, packed << 10 | numbers[:, axis])
    return np.asarray(packed.astype("<u4")[:, None].view(np.uint8))


def _smallest_three(table: Bytes) -> NDArray[np.float32]:
    packed = np.ascontiguousarray(table).view("<u4")[:, 0]
    largest = packed >> 30
    units = np.zeros((len(packed), 4))
    for axis in (3, 2, 1, 0):
        others = largest != axis
        size = (packed & 511) / _THREE_STEPS
        units[:, axis] = np.where(others, np.where(packed & 512, -size, size), 0.0)
        packed = np.where(others, packed >> 10, packed)
    rest = np.sqrt(np.maximum(0, 1 - (units**2).sum(axis=1)))
    np.put_along_axis(units, largest[:, None].astype(np.int64), rest[:, None], axis=1)
    return units[:, [3, 0, 1, 2]].astype(np.float32)


def _harmonics(rest: NDArray[np.float32]) -> Bytes:
    """Return [N, 3 B] bytes of the coefficients [N, B, 3]."""
    merged = np.full((rest.shape[1], 1), _STEP_REST, np.float32)
    merged[:_FIRST_BAND] = _STEP_FIRST
    steps = np.rint(rest * (_SH_STEPS / merged)) * merged + _SH_STEPS
    return np.asarray(np.clip(steps, 0, 255).astype(np.uint8).reshape(len(rest), -1))
