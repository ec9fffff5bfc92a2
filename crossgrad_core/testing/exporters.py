"""Contract checks of exporters."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from crossgrad_core.contract.exporter import Exporter
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.similarity import Similarity
from crossgrad_core.testing.components import COMPONENT_CHECKS
from crossgrad_core.testing.contract import Check, Make, require
from crossgrad_core.testing.fixtures import sample_gaussians

_FRAME = Similarity(np.array([1.0, -2.0, 3.0]), 0.5)


def has_a_suffix(make: Make[Exporter]) -> None:
    """`suffix` is what follows the dot in the names of its files."""
    suffix = getattr(make(), "suffix", None)
    good = isinstance(suffix, str) and suffix.isalnum() and suffix == suffix.lower()
    require(good, f"suffix is {suffix!r}; it must be lower-case letters and digits, without a dot")


def writes_one_file(make: Make[Exporter]) -> None:
    """The named file alone is written, the same bytes for the same Gaussians, which stay so."""
    with TemporaryDirectory() as folder:
        first, second = (Path(folder) / name for name in ("a", "b"))
        for path in (first, second):
            given = _gaussians()
            notes: object = make().write(given, _FRAME, path, ("a comment",))
            _require_kept(given, "write")
            good = isinstance(notes, tuple) and all(isinstance(note, str) for note in notes)
            require(good, f"write() answers {notes!r}, not a tuple of sentences")
        found = sorted(path.name for path in Path(folder).iterdir())
        require(found == ["a", "b"], f"two files were to be written; the folder holds {found}")
        require(first.stat().st_size > 0, "the file is empty")
        same = first.read_bytes() == second.read_bytes()
        require(same, "the same Gaussians give different files")


def the_stored_ones_can_be_drawn(make: Make[Exporter]) -> None:
    """`stored` gives finite Gaussians, as many as it got, and leaves its own as they are."""
    given = _gaussians()
    stored = make().stored(given)
    require(isinstance(stored, Gaussians), f"stored() answers {stored!r}, not Gaussians")
    require(len(stored) == len(given), f"{len(given)} Gaussians became {len(stored)}")
    for name in ("means", "quats", "scales", "opacities"):
        require(getattr(stored, name).isfinite().all(), f"the stored {name} are not finite")
    _require_kept(given, "stored")


def _require_kept(given: Gaussians, method: str) -> None:
    same = all(map(torch.equal, given.floats(), _gaussians().floats()))
    require(same, f"{method}() changes the Gaussians that it was given")


def _gaussians() -> Gaussians:
    return sample_gaussians(harmonics=True).detached()


EXPORTER_CHECKS: tuple[Check[Exporter], ...] = (
    *COMPONENT_CHECKS,
    has_a_suffix,
    writes_one_file,
    the_stored_ones_can_be_drawn,
)
