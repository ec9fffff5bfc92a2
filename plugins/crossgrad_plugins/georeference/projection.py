"""Map coordinates, given by their EPSG codes."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Json, UserError
from crossgrad_plugins.georeference.ellipsoid import Place
from crossgrad_plugins.georeference.frames import Frame3D

if TYPE_CHECKING:
    from pyproj import Transformer

_CODE: Final = re.compile(r"epsg:[0-9]{1,6}", re.IGNORECASE | re.ASCII)
_SHOWN: Final = 80
#: EPSG code of geocentric coordinates on WGS 84.
GEOCENTRIC: Final = "epsg:4978"
#: Distance in metres from a point to both ends of the interval over which the projection is
#: linearized.
_NEAR: Final = 10.0
#: A message about accuracy is printed only if the accuracy in metres is worse than this.
_KNOWN_WELL: Final = 1.0
#: Maximum relative difference of the scale between directions. Within a UTM zone, the difference is
#: at most 0.001.
_UNEVEN: Final = 0.005


@dataclass(frozen=True, eq=False)
class Projection:
    """A coordinate reference system whose axes all have units of length.

    Attributes:
        code: The code, such as `epsg:32633`.
        forward: Conversion from geocentric coordinates; on a map, x is east and y is north.
        accuracy: Accuracy in metres relative to WGS 84; None if PROJ does not report it.
    """

    code: str
    forward: "Transformer"
    accuracy: float | None

    @classmethod
    def of(cls, code: str, where: str) -> "Projection":
        """Return the coordinate system of a code.

        Args:
            code: A code such as `epsg:32633`.
            where: Option or file that contains the code, for error messages.

        Raises:
            UserError: The code is invalid or unknown, or pyproj or a grid file is missing.
        """
        # Accept only codes, because PROJ would also accept strings that name an arbitrary file.
        if not _CODE.fullmatch(code):
            raise _unknown(where, repr(code)[:_SHOWN])
        try:
            from pyproj import CRS, Transformer
            from pyproj.exceptions import CRSError, ProjError
        except ImportError as error:
            raise UserError(
                "coordinates of an EPSG code need the package pyproj",
                where=where,
                found="pyproj is not installed",
                todo='pip install "crossgrad[geo]"',
            ) from error
        try:
            system = CRS.from_user_input(code).to_3d()
            forward = Transformer.from_crs(GEOCENTRIC, system, always_xy=True, allow_ballpark=False)
        except (CRSError, ProjError) as error:
            raise _unknown(where, str(error).partition("\n")[0]) from error
        return cls(code, forward, forward.accuracy if forward.accuracy >= 0.0 else None)

    @property
    def facts(self) -> dict[str, Json]:
        """The entries of `.georef.json` for a file in this coordinate system."""
        return {"crs": self.code.upper(), "crs_accuracy_m": self.accuracy}

    @property
    def messages(self) -> tuple[str, ...]:
        """Messages about the accuracy of coordinates in this coordinate system."""
        if self.accuracy is None:
            return (
                (
                    f"{self.code}: PROJ does not report the accuracy; positions may be wrong by "
                    "metres"
                ),
            )
        if self.accuracy > _KNOWN_WELL:
            return (f"{self.code}: accurate to {self.accuracy:g} m, according to PROJ",)
        return ()

    def points(self, geocentric: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert geocentric coordinates [N, 3] to this system, [N, 3]; infinite if undefined."""
        return np.column_stack(self.forward.transform(*geocentric.T))

    def geocentric(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points [N, 3] to geocentric coordinates [N, 3]; NaN if undefined."""
        converted = np.column_stack(self.forward.transform(*points.T, direction="INVERSE"))
        return np.where(np.isfinite(converted), converted, np.nan)

    def near(self, to_enu: Frame3D, place: NDArray[np.float64], where: str) -> Frame3D:
        """Fit the similarity from east, north and up to this coordinate system near a position.

        Args:
            to_enu: Conversion from geocentric coordinates to east, north and up.
            place: [3] the position in east, north and up.
            where: Option or file that contains the code, for error messages.

        Raises:
            UserError: Near the position, the coordinate system is undefined, mirrors, or has
                different scales along its axes.
        """
        ends = place + _NEAR * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        here, *sides = self.points(to_enu.inverse.points(ends))
        stretch = (np.array(sides[:3]) - np.array(sides[3:])).T / (2.0 * _NEAR)
        if not np.isfinite(stretch).all():
            raise self._unusable(where, "the scene is outside the area of the coordinate system")
        left, sizes, right = np.linalg.svd(stretch)
        rotation = left @ right
        if np.linalg.det(rotation) < 0.0:
            raise self._unusable(where, "its axes are left-handed")
        if sizes[0] > (1.0 + _UNEVEN) * sizes[2]:
            raise self._unusable(
                where,
                f"one metre is {sizes[2]:.4g} to {sizes[0]:.4g} units, depending on the direction",
            )
        scale = float(np.cbrt(sizes.prod()))
        return Frame3D(rotation, here - scale * rotation @ place, scale)

    def _unusable(self, where: str, reason: str) -> UserError:
        return UserError(
            f"Gaussians cannot be exported in {self.code}",
            where=where,
            expected="a right-handed system with the same unit on all axes",
            found=reason,
            todo="use UTM (--coordinates utm) or enu",
        )


def _unknown(where: str, reason: str) -> UserError:
    return UserError(
        "PROJ cannot convert to these coordinates",
        where=where,
        found=reason,
        todo="check the code, or use a code of WGS 84 or ETRS89 without a height system, "
        "such as epsg:32633 or epsg:25833",
    )


def utm_code(place: Place) -> str:
    """Return the EPSG code of a position's UTM zone, without the exceptions for Norway."""
    zone = int((place.longitude + 180.0) // 6.0) % 60 + 1
    return f"epsg:{(32600 if place.latitude >= 0.0 else 32700) + zone}"
