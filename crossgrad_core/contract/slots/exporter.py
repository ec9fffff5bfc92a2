"""The exporter slot: the trained Gaussians -> a file that other programs open."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Similarity
from crossgrad_core.errors import UserError


@dataclass(frozen=True, eq=False)
class Rounding:
    """How a file keeps positions.

    Attributes:
        offset: [3] float64, what is to be added to the numbers of the file.
        largest: How far rounding moves a Gaussian at most, in the file's units; None where the
            exporter does not tell.
    """

    offset: NDArray[np.float64]
    largest: float | None = None


class Exporter(Component):
    """Writes Gaussians to a file of one format.

    Attributes:
        suffix: Suffix of its files, without the dot.
    """

    slot: ClassVar[str] = "exporters"
    suffix: ClassVar[str]

    @abstractmethod
    def write(
        self, gaussians: Gaussians, similarity: Similarity, path: Path, comments: Sequence[str]
    ) -> tuple[str, ...]:
        """Writes the file; it appears complete or not at all.

        Args:
            gaussians: Gaussians of the local frame that do not depend on a view, without a graph.
            similarity: Maps the local frame back to the input frame, in which files are written.
            path: The file.
            comments: Lines of plain text about the file, for formats that can hold them.

        Returns:
            What the user should know about the file, one sentence each; usually nothing.

        Raises:
            UserError: The disk is full or the folder may not be written to.
        """

    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        """How positions are kept in the file that `write` makes of the same."""
        return Rounding(np.zeros(3))

    def stored(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians as a reader of the file gets them, local frame; by default unchanged."""
        return gaussians

    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        """The Gaussians in a file of this format, to start from; by default refused.

        Args:
            path: The file.
            similarity: Maps the local frame, that of the answer, back to the frame of the file.

        Returns:
            float32 Gaussians on the CPU with spherical harmonics.

        Raises:
            UserError: The file cannot be read.
        """
        raise _not_read(path)

    def sh_degree_of(self, path: Path) -> int:
        """The SH degree of the Gaussians in a file, from its header alone; by default refused.

        Raises:
            UserError: The file cannot be read.
        """
        raise _not_read(path)


def _not_read(path: Path) -> UserError:
    return UserError(
        "files of this format are written, not read",
        where=path,
        todo="name a file of a format that a run can start from, such as a PLY of Gaussians",
    )
