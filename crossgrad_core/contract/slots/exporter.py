"""The exporter slot: a component writes the trained Gaussians to a file for other programs."""

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
    """The offset and the rounding error of positions in a file.

    Attributes:
        offset: [3] float64, added to the numbers of the file to get positions.
        largest: Largest distance by which rounding moves a Gaussian, in the file's units; None if
            the exporter does not report it.
    """

    offset: NDArray[np.float64]
    largest: float | None = None


class Exporter(Component):
    """A writer of Gaussians to files of one format.

    Attributes:
        suffix: Suffix of the exporter's files, without the dot.
    """

    slot: ClassVar[str] = "exporters"
    suffix: ClassVar[str]

    @abstractmethod
    def write(
        self, gaussians: Gaussians, similarity: Similarity, path: Path, comments: Sequence[str]
    ) -> tuple[str, ...]:
        """Write the file; either the complete file appears or no file.

        Args:
            gaussians: View-independent Gaussians in the local frame, without a graph.
            similarity: Maps the local frame back to the input frame, in which files are written.
            path: The file.
            comments: Lines of plain text about the file, for formats that can hold them.

        Returns:
            Messages for the user about the file, one sentence each; usually none.

        Raises:
            UserError: The disk is full, or the folder is not writable.
        """

    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        """Return offset and rounding error of positions in the file that `write` creates."""
        return Rounding(np.zeros(3))

    def stored(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians that the file stores, in the local frame; by default unchanged."""
        return gaussians

    def read(self, path: Path, similarity: Similarity) -> Gaussians:
        """Return the Gaussians in a file, to start a run from; by default raise an error.

        Args:
            path: The file.
            similarity: Maps the local frame, the frame of the result, to the frame of the file.

        Returns:
            float32 Gaussians on the CPU with spherical harmonics.

        Raises:
            UserError: The file cannot be read.
        """
        raise _not_read(path)

    def sh_degree_of(self, path: Path) -> int:
        """Return the SH degree that the header of a file gives; by default raise an error.

        Raises:
            UserError: The file cannot be read.
        """
        raise _not_read(path)


def _not_read(path: Path) -> UserError:
    return UserError(
        "a run cannot start from a file of this format: crossgrad writes the format "
        "but does not read it",
        where=path,
        todo="use a file of a format that a run can start from, such as a PLY of Gaussians",
    )
