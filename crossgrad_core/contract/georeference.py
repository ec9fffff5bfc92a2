"""A scene's place on Earth, and the coordinates in which files can hold it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.similarity import Similarity
from crossgrad_core.contract.state import Json
from crossgrad_core.errors import UserError

#: Those of the scene's files, and those that are trained in.
INPUT, LOCAL = "input", "local"
_KNOWN: Final = re.compile(rf"{INPUT}|{LOCAL}|enu|utm|epsg:[0-9]{{4,6}}")
#: Begins the comment of a file that is in other coordinates than the scene's.
COORDINATES_TAG = "crossgrad_coordinates:"


@dataclass(frozen=True, eq=False)
class Placed:
    """Gaussians on their way into a file.

    Attributes:
        gaussians: Of a frame that may be turned against the local one.
        similarity: Maps that frame to the coordinates of the file.
        facts: Of `.georef.json`, for programs that read the file; empty where nothing is known.
        notes: What the user should know, one sentence each.
    """

    gaussians: Gaussians
    similarity: Similarity
    facts: Mapping[str, Json] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


class Georeference(Protocol):
    """A scene's place on Earth, as far as it is known."""

    @property
    def note(self) -> str:
        """The place and how well it is known, or why it is not, in a sentence."""
        ...

    def placed(self, gaussians: Gaussians, similarity: Similarity, coordinates: str) -> Placed:
        """Gaussians in coordinates that were asked for.

        Args:
            gaussians: Of the local frame, without a graph.
            similarity: Maps the local frame back to the input frame.
            coordinates: As `check_coordinates` takes them.

        Raises:
            UserError: The scene cannot be put into these coordinates.
        """
        ...


@dataclass(frozen=True)
class Unplaced:
    """A scene whose place is not known.

    Attributes:
        why: What is missing.
    """

    why: str = "neither its files nor its photos tell where on Earth it is"

    @property
    def note(self) -> str:
        """See `Georeference`."""
        return f"not georeferenced: {self.why}"

    def placed(self, gaussians: Gaussians, similarity: Similarity, coordinates: str) -> Placed:
        """See `Georeference`."""
        if coordinates == INPUT:
            return Placed(gaussians, similarity)
        if coordinates == LOCAL:
            return Placed(gaussians, Similarity(np.zeros(3), 1.0), {"coordinates": LOCAL})
        raise UserError(
            "the scene is not georeferenced",
            where=f"--coordinates {coordinates}",
            found=self.why,
            todo="export in input or local coordinates, or see docs/coordinates.md for what tells "
            "a scene's place",
        )


#: A scene of which nothing is known.
UNPLACED: Final = Unplaced()


def check_coordinates(name: str) -> None:
    """Refuses coordinates that do not exist.

    Raises:
        UserError: They are none of those that a file can be in.
    """
    if not _KNOWN.fullmatch(name):
        raise UserError(
            "there are no such coordinates",
            where=f"--coordinates {name}",
            expected="input, local, enu (metres east, north, up), utm, or epsg:N such as "
            "epsg:32633",
            todo="choose one of these",
        )
