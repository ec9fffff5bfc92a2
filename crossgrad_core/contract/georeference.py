"""Frames of a scene: the local frame, the frame of its input files, and its location on Earth."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.errors import UserError


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map x_local = (x_input - offset) * scale, in float64, without a rotation.

    Attributes:
        offset: [3] float64, input frame.
        scale: Local units per input unit.
    """

    offset: NDArray[np.float64]
    scale: float

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [N, 3] points of the input frame in the local frame."""
        return (points - self.offset) * self.scale

    def to_input(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [N, 3] points of the local frame in the input frame."""
        return points / self.scale + self.offset


#: Coordinates of the scene's files, and coordinates of training.
INPUT, LOCAL = "input", "local"
_KNOWN: Final = re.compile(rf"{INPUT}|{LOCAL}|enu|utm|epsg:[0-9]{{4,6}}")
#: Prefix of the comment in a file whose coordinates differ from the scene's coordinates.
COORDINATES_TAG = "crossgrad_coordinates:"


@dataclass(frozen=True, eq=False)
class Placed:
    """Gaussians in the coordinates in which an export writes them to a file.

    Attributes:
        gaussians: Gaussians in a frame that may be rotated with respect to the local frame.
        similarity: Maps the frame of `gaussians` to the coordinates of the file.
        facts: Contents of the file `.georef.json`; empty if there are no facts about the
            coordinates.
        notes: Messages for the user, one sentence each.
        rotation: [3, 3] float64, rotates the local frame to the frame of `gaussians`. Both frames
            have the same origin and scale.
        to_ecef: [4, 4] float64, maps coordinates of the file to ECEF metres on the WGS 84
            ellipsoid; None if the location is not known.
    """

    gaussians: Gaussians
    similarity: Similarity
    facts: Mapping[str, Json] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    to_ecef: NDArray[np.float64] | None = None


class Georeference(Protocol):
    """The location of a scene on Earth, or the reason why the location is not known."""

    @property
    def note(self) -> str:
        """One sentence with the location and its accuracy, or why the location is not known."""
        ...

    @property
    def up(self) -> NDArray[np.float64] | None:
        """[3] unit vector that points up, in the input frame; None if it is not known."""
        ...

    def placed(self, gaussians: Gaussians, similarity: Similarity, coordinates: str) -> Placed:
        """Return Gaussians in the requested coordinates.

        Args:
            gaussians: Gaussians in the local frame, without a graph.
            similarity: Maps the local frame back to the input frame.
            coordinates: A name that `check_coordinates` accepts.

        Raises:
            UserError: The scene cannot be put into these coordinates.
        """
        ...


@dataclass(frozen=True)
class Unplaced:
    """The georeference of a scene whose location is not known.

    Attributes:
        why: The reason why the location is not known.
    """

    why: str = "neither the scene files nor the photos contain a position on Earth"

    @property
    def note(self) -> str:
        """See `Georeference`."""
        return f"not georeferenced: {self.why}"

    @property
    def up(self) -> None:
        """None; see `Georeference`."""
        return

    def placed(self, gaussians: Gaussians, similarity: Similarity, coordinates: str) -> Placed:
        """Return the Gaussians in input or local coordinates; refuse all other coordinates."""
        if coordinates == INPUT:
            return Placed(gaussians, similarity)
        if coordinates == LOCAL:
            return Placed(gaussians, Similarity(np.zeros(3), 1.0), {"coordinates": LOCAL})
        raise UserError(
            "the scene cannot be exported in these coordinates: it is not georeferenced",
            where=f"--coordinates {coordinates}",
            found=self.why,
            todo="export in input or local coordinates; docs/coordinates.md explains how to "
            "georeference a scene",
        )


#: The georeference of a scene without any information on its location.
UNPLACED: Final = Unplaced()


def check_coordinates(name: str) -> None:
    """Check the name of output coordinates.

    Raises:
        UserError: A file cannot be written in coordinates of this name.
    """
    if not _KNOWN.fullmatch(name):
        raise UserError(
            "the coordinate system is unknown",
            where=f"--coordinates {name}",
            expected="input, local, enu (metres east, north, up), utm, or epsg:N such as "
            "epsg:32633",
            todo="choose one of the listed systems",
        )
