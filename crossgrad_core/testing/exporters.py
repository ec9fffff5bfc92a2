"""Contract checks for exporters."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.slots.exporter import ExportContent, Exporter
from crossgrad_core.testing.fixtures import sample_gaussians
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import Check, Make, cannot_tell, require

_FRAME = Similarity(np.array([1.0, -2.0, 3.0]), 0.5)
#: Rounding error after a few float32 operations on numbers near 1.
_ROUNDING = 1e-5


def has_a_suffix(make: Make[Exporter]) -> None:
    """`suffix` is the suffix of the exporter's file names, without the dot; empty for a folder."""
    suffix = getattr(make(), "suffix", None)
    good = isinstance(suffix, str) and (suffix.isalnum() or not suffix) and suffix == suffix.lower()
    require(good, f"suffix is {suffix!r}; it must be lower-case letters and digits, without a dot")


def writes_one_file(make: Make[Exporter]) -> None:
    """Only the named file or folder is written.

    Equal Gaussians give equal bytes, and `write` does not change the Gaussians.
    """
    with TemporaryDirectory() as folder:
        first, second = (Path(folder) / name for name in ("a", "b"))
        for path in (first, second):
            given = _gaussians()
            notes: object = make().write(
                ExportContent(given, _FRAME, comments=("a comment",)), path
            )
            _require_kept(given, "write")
            good = isinstance(notes, tuple) and all(isinstance(note, str) for note in notes)
            require(good, f"write() returns {notes!r}, not a tuple of strings")
        file_names = sorted(path.name for path in Path(folder).iterdir())
        require(
            file_names == ["a", "b"], f"two files were expected; the folder contains {file_names}"
        )
        require(any(_content(first).values()), "the file is empty")
        if first.is_file():
            size, largest = first.stat().st_size, make().largest_size(len(_gaussians()))
            require(
                largest is None or size <= largest,
                f"the file has {size} bytes; largest_size() announces at most {largest}",
            )
        same = _content(first) == _content(second)
        require(same, "two exports of the same Gaussians differ")


def appears_at_once(make: Make[Exporter]) -> None:
    """An existing file is replaced as a whole. The exporter never overwrites a file in place."""
    if not make().suffix:
        raise cannot_tell("the exporter writes a folder, which is never replaced")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        make().write(ExportContent(_gaussians(), _FRAME), path)
        before = path.stat().st_ino
        if not before:
            raise cannot_tell("this file system has no inode numbers")
        make().write(ExportContent(_gaussians(), _FRAME), path)
        require(
            path.stat().st_ino != before,
            "write() overwrites the file in place, so a reader or a full disk can leave "
            "an incomplete file; expected an atomic write: write to another name in the "
            "folder and rename the file, or use crossgrad_core.plugin.atomic_file",
        )


def writes_the_input_frame(make: Make[Exporter]) -> None:
    """If the offset or scale of the local frame changes, the coordinates in the file change."""
    exporter, given = make(), _gaussians()
    offset = Similarity(_FRAME.offset + np.array([8.0, 16.0, -4.0]), _FRAME.scale)
    scale = Similarity(_FRAME.offset, 4.0 * _FRAME.scale)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a"
        exporter.write(ExportContent(given, _FRAME), path)
        written, rounding = _content(path), exporter.rounding(given, _FRAME)
        for similarity, what in ((offset, "offset"), (scale, "scale")):
            path = Path(folder) / what
            exporter.write(ExportContent(given, similarity), path)
            moved = not np.array_equal(exporter.rounding(given, similarity).offset, rounding.offset)
            require(
                _content(path) != written or moved,
                f"another {what} of the similarity gives the same file: write() writes the "
                "local frame; expected the input frame: positions by similarity.to_input, "
                "lengths divided by similarity.scale",
            )


def what_it_writes_is_read_again(make: Make[Exporter]) -> None:
    """`read` returns positions, sizes and opacities of the result of `stored`.

    The values may differ by float32 rounding.
    """
    exporter = make()
    if type(exporter).read is Exporter.read:
        raise cannot_tell("crossgrad writes files of this format but does not read them")
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{exporter.suffix}"
        exporter.write(ExportContent(_gaussians(), _FRAME), path)
        read_back = exporter.read(path, _FRAME)
    stored = exporter.stored(_gaussians(), _FRAME)
    require(
        len(read_back) == len(stored),
        f"{len(stored)} Gaussians were written, but {len(read_back)} were read",
    )
    # The large offset of the input frame removes the last bits of positions.
    size = float(np.abs(_FRAME.offset).max()) * _FRAME.scale
    for name in ("means", "scales", "opacities"):
        error = float((getattr(read_back, name) - getattr(stored, name)).abs().max())
        require(
            error <= _ROUNDING * max(1.0, size),
            f"read() returns {name} that differ from those of stored() by up to "
            f"{error:.2g}; expected the local frame, up to rounding",
        )


def the_stored_ones_can_be_drawn(make: Make[Exporter]) -> None:
    """`stored` returns as many finite Gaussians as it received, and does not change its input."""
    given = _gaussians()
    stored = make().stored(given, _FRAME)
    require(isinstance(stored, Gaussians), f"stored() returns {stored!r}, not Gaussians")
    require(len(stored) == len(given), f"{len(given)} Gaussians became {len(stored)}")
    for name in ("means", "quats", "scales", "opacities"):
        require(getattr(stored, name).isfinite().all(), f"the stored {name} are not finite")
    _require_kept(given, "stored")


def _content(path: Path) -> dict[str, bytes]:
    """Return the bytes of a file, or of all files of a folder by their names."""
    files = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    return {each.relative_to(path).as_posix(): each.read_bytes() for each in files}


def _require_kept(given: Gaussians, method: str) -> None:
    same = all(map(torch.equal, given.floats(), _gaussians().floats()))
    require(same, f"{method}() changes the Gaussians that it received")


def _gaussians() -> Gaussians:
    return sample_gaussians(harmonics=True).detached()


EXPORTER_CHECKS: tuple[Check[Exporter], ...] = (
    *COMPONENT_CHECKS,
    has_a_suffix,
    writes_one_file,
    appears_at_once,
    writes_the_input_frame,
    what_it_writes_is_read_again,
    the_stored_ones_can_be_drawn,
)
