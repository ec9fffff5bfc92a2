"""The exporter slot: a component writes the trained Gaussians to a file for other programs."""

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.gaussians import Gaussians, Response
from crossgrad_core.contract.georeference import INPUT, Similarity
from crossgrad_core.contract.scene import View
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


@dataclass(frozen=True, eq=False)
class ExportContent:
    """The content of a file that an exporter writes.

    Attributes:
        gaussians: View-independent Gaussians without a graph, at least one. Their frame is the
            local frame, or is rotated against it.
        similarity: Maps the frame of `gaussians` to the coordinates of the file.
        views: The training views, with cameras in the frame of `gaussians`.
        up: [3] float64 unit vector that points up in the frame of `gaussians`; None if unknown.
        to_ecef: [4, 4] float64, maps coordinates of the file to ECEF metres on the WGS 84
            ellipsoid; None if the location is not known.
        comments: Lines of plain text about the file, for formats that can hold them.
        name: Name of the scene.
    """

    gaussians: Gaussians
    similarity: Similarity
    views: tuple[View, ...] = ()
    up: NDArray[np.float64] | None = None
    to_ecef: NDArray[np.float64] | None = None
    comments: tuple[str, ...] = ()
    name: str = "scene"


class Exporter(Component):
    """A writer of Gaussians to files of one format.

    Attributes:
        suffix: Suffix of the exporter's files, without the dot; empty for a folder of files.
        up: The axis that points up in the format's coordinates: `y`, `z`, or `input` if the format
            keeps the axes of the input. It is the default of `--up`.
        coordinates: The default of `--coordinates`, if the scene can be exported in them.
        lossy: True if the file approximates the Gaussians; then the loss in dB is measured.
        responses: The responses of Gaussians that the format can store.
        keeps_response: True if all viewers of the format draw these responses as crossgrad does.
            Then Gaussians keep the response of their backbone, and are not baked for it.
    """

    slot: ClassVar[str] = "exporters"
    suffix: ClassVar[str]
    up: ClassVar[str] = INPUT
    coordinates: ClassVar[str] = INPUT
    lossy: ClassVar[bool] = False
    responses: ClassVar[frozenset[Response]] = frozenset({"plain"})
    keeps_response: ClassVar[bool] = False

    @abstractmethod
    def write(self, content: ExportContent, path: Path) -> tuple[str, ...]:
        """Write the file; either the complete file appears or no file.

        Args:
            content: The Gaussians, and the facts about their scene.
            path: The file. If `suffix` is empty, it is the folder, which does not exist yet.

        Returns:
            Messages for the user about the file, one sentence each; usually none.

        Raises:
            UserError: The disk is full, or the folder is not writable.
        """

    def largest_size(self, gaussians: int) -> int | None:
        """Return an upper limit of the size in bytes of a file with this number of Gaussians.

        Cameras are not counted. By default None: the exporter does not know a limit.
        """
        return None

    def rounding(self, gaussians: Gaussians, similarity: Similarity) -> Rounding:
        """Return offset and rounding error of positions in the file that `write` creates."""
        return Rounding(np.zeros(3))

    def stored(self, gaussians: Gaussians, similarity: Similarity) -> Gaussians:
        """Return the Gaussians that `write` stores for `gaussians`, in their frame and order.

        By default they are unchanged.
        """
        return gaussians

    def is_of_format(self, path: Path) -> bool:
        """Return True if the name of a file shows that it has this format."""
        return bool(self.suffix) and path.name.lower().endswith(f".{self.suffix}")

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
