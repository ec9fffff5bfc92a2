"""A scene with a known position on Earth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.plugin import INPUT, LOCAL, Gaussians, Json, Placed, Similarity
from crossgrad_plugins.georeference.ellipsoid import Place
from crossgrad_plugins.georeference.frames import SAME, Frame3D
from crossgrad_plugins.georeference.projection import Projection, utm_code

#: Root mean square distances between photos and their GPS positions, in metres: in 3D, horizontal
#: and vertical.
RESIDUALS: Final = ("median", "rms", "max", "rms_horizontal", "rms_vertical")
_CONVENTION: Final = (
    "position = numbers of the file + offset; [east, north, up, 1] = transform [position, 1], "
    "metres from the origin; [input, 1] = to_input [position, 1]; matrices row by row; altitude "
    "above the ellipsoid of WGS 84 where the source has it so"
)


@dataclass(frozen=True, eq=False)
class OnEarth:
    """A scene with a known position on Earth.

    Attributes:
        origin: The origin of the coordinates east, north and up.
        to_enu: Conversion from the coordinates of the input to metres east, north and up of the
            origin.
        source: The source of the georeference, as text.
        residuals: Name from `RESIDUALS` -> metres; empty if there was no GPS position to compare
            with.
        system: The coordinate system of the input, or None if the input has no map coordinates. The
            conversion from map coordinates to east, north and up is not a similarity. The
            coordinate system therefore converts the centres, and `to_enu` is the best similarity at
            the origin.
    """

    origin: Place
    to_enu: Frame3D
    source: str
    residuals: Mapping[str, float] = field(default_factory=dict)
    system: Projection | None = None

    @property
    def note(self) -> str:
        """One sentence about the georeference; see `crossgrad_core.plugin.Georeference`."""
        parts = [f"{name.replace('_', ' ')} {m:.2f} m" for name, m in self.residuals.items()]
        residual_text = f"; residuals: {', '.join(parts)}" if parts else ""
        return (
            f"georeferenced by {self.source}: origin at {self.origin.text}, 1 unit = "
            f"{self.to_enu.scale:.6g} m{residual_text}"
        )

    @property
    def up(self) -> NDArray[np.float64]:
        """[3] unit vector: up at the origin, in the frame of the input files."""
        return np.asarray(self.to_enu.rotation[2])

    def placed(self, gaussians: Gaussians, similarity: Similarity, coordinates: str) -> Placed:
        """Return the model in map coordinates; see `crossgrad_core.plugin.Georeference`."""
        facts = {**self._facts(), "coordinates": coordinates}
        centers = similarity.to_input(_means(gaussians))
        here = self._enu_of(centers)
        if self.system is not None and coordinates in {INPUT, LOCAL}:
            facts["transform_error_m"] = _apart(self.to_enu.points(centers), here)
        if coordinates == INPUT:
            facts |= self.system.facts if self.system is not None else {}
            return Placed(
                gaussians, similarity, {**facts, **self._ways(SAME)}, to_ecef=self._to_ecef(SAME)
            )
        if coordinates == LOCAL:
            local = Frame3D(np.eye(3), -similarity.scale * similarity.offset, similarity.scale)
            return Placed(
                gaussians,
                Similarity(np.zeros(3), 1.0),
                {**facts, **self._ways(local)},
                to_ecef=self._to_ecef(local),
            )
        if coordinates == "enu":
            return self._turned(gaussians, similarity, self.to_enu, here, facts)
        where, code = f"--coordinates {coordinates}", coordinates
        projection = Projection.of(utm_code(self.origin) if code == "utm" else code, where)
        middle = self.to_enu.points(similarity.offset[None])[0]
        frame = projection.near(self.origin.to_enu, middle, where).after(self.to_enu)
        points = projection.points(self.origin.to_enu.inverse.points(here))
        metres = self.to_enu.scale / frame.scale
        facts |= projection.facts
        facts["transform_error_m"] = _apart(metres * points, metres * frame.points(centers))
        placed = self._turned(gaussians, similarity, frame, points, facts)
        return replace(placed, notes=projection.messages)

    def _enu_of(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points [N, 3] of the input to metres east, north and up of the origin."""
        if self.system is None:
            return self.to_enu.points(points)
        return self.origin.to_enu.points(self.system.geocentric(points))

    def _turned(
        self,
        gaussians: Gaussians,
        similarity: Similarity,
        frame: Frame3D,
        points: NDArray[np.float64],
        facts: dict[str, Json],
    ) -> Placed:
        """Return Gaussians at `points` [N, 3].

        A similarity from the input frame rotates and scales them. The Gaussians get a new frame
        with the size of the local frame and another rotation, so that an exporter only has to move
        and scale them.
        """
        offset = frame.points(similarity.offset[None])[0]
        frame_similarity = Similarity(offset, similarity.scale / frame.scale)
        means = torch.from_numpy(frame_similarity.to_local(points)).to(gaussians.means.device)
        return Placed(
            gaussians.rotated(torch.from_numpy(frame.rotation), means),
            frame_similarity,
            {**facts, **self._ways(frame)},
            rotation=frame.rotation,
            to_ecef=self._to_ecef(frame),
        )

    def _to_ecef(self, frame: Frame3D) -> NDArray[np.float64]:
        """Return the map [4, 4] to ECEF metres from coordinates to which `frame` maps the input."""
        return self.origin.to_enu.inverse.after(self.to_enu).after(frame.inverse).matrix

    def _facts(self) -> dict[str, Json]:
        """Return the facts that are true in any coordinate system."""
        residuals: dict[str, Json] = dict(self.residuals)
        return {
            "crs": None,
            "origin": dict(vars(self.origin)),
            "source": self.source,
            "residuals_m": residuals,
            "convention": _CONVENTION,
        }

    def _ways(self, frame: Frame3D) -> dict[str, Json]:
        """Return a file's matrices, for the coordinates to which `frame` converts the input."""
        back = frame.inverse
        to_enu = self.to_enu.after(back)
        return {
            "metres_per_unit": to_enu.scale,
            "transform": to_enu.matrix.tolist(),
            "to_input": back.matrix.tolist(),
        }


def _means(gaussians: Gaussians) -> NDArray[np.float64]:
    return np.asarray(gaussians.means.detach().cpu().double().numpy())


def _apart(points: NDArray[np.float64], others: NDArray[np.float64]) -> float | None:
    """Return the distance between two sets of points [N, 3]; None if no distance is finite.

    The 99th percentile of the distances is used, because the farthest points may be at the horizon.
    """
    off = np.linalg.norm(points - others, axis=1)
    off = off[np.isfinite(off)]
    return float(np.quantile(off, 0.99)) if len(off) else None
