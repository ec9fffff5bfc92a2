"""Edits of exported Gaussians: fewer bands, another up axis, a crop, and fewer Gaussians."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.georeference import INPUT, LOCAL, Placed, Similarity
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.errors import UserError
from crossgrad_core.system.text_files import read_rows
from crossgrad_core.training.setup import Setup

#: Number of values of a box: its smallest and its largest x, y and z.
_BOX: Final = 6
_FEWEST_CORNERS: Final = 3


@dataclass(frozen=True, eq=False)
class Crop:
    """A part of space, in the coordinates of the file.

    Attributes:
        box: [2, 3] smallest and largest coordinates; None for a polygon.
        polygon: [C, 2] corners on the ground; None for a box. The ground is x and y, or x and z if
            y points up.
    """

    box: NDArray[np.float64] | None = None
    polygon: NDArray[np.float64] | None = None

    @classmethod
    def parsed(cls, text: str) -> "Crop":
        """Return the part of space that `--crop` names: six numbers, or a file of corners.

        Raises:
            UserError: The text is neither, or the file has no polygon.
        """
        words = text.split(",")
        if len(words) == _BOX:
            box = np.array([_number(word, text) for word in words]).reshape(2, 3)
            if not (box[0] < box[1]).all():
                raise _wrong_crop(text, "the largest coordinate of an axis is not above the least")
            return cls(box=box)
        path = Path(text)
        if not path.is_file():
            raise _wrong_crop(text, "neither six numbers nor a file")
        table = read_rows(path, "the polygon of --crop", "write one corner `x,y` per line")
        rows = [row for row in table if any(word.strip() for word in row)]
        corners = [[_number(word, text) for word in row] for row in rows]
        if len(corners) < _FEWEST_CORNERS or any(len(corner) != 2 for corner in corners):  # noqa: PLR2004
            raise _wrong_crop(text, f"{len(corners)} lines that are not all two numbers")
        return cls(polygon=np.array(corners))

    def inside(self, points: NDArray[np.float64], up: str) -> NDArray[np.bool_]:
        """Return a mask [N] of the points [N, 3] inside the crop region; `up` is the up axis."""
        if self.box is not None:
            return np.asarray(((points >= self.box[0]) & (points <= self.box[1])).all(axis=1))
        assert self.polygon is not None
        x, y = (points[:, [0, 2]] if up == "y" else points[:, :2]).T
        inside = np.zeros(len(points), dtype=np.bool_)
        # A point is inside the polygon if its ray along x crosses an odd number of polygon edges.
        for (x0, y0), (x1, y1) in zip(self.polygon, np.roll(self.polygon, -1, axis=0), strict=True):
            if y0 != y1:
                crosses = (y0 > y) != (y1 > y)
                inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
        return inside


def _number(word: str, text: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise _wrong_crop(text, f"{word.strip()!r} is not a number")
    return value


def _wrong_crop(text: str, found: str) -> UserError:
    return UserError(
        "the part of space to export cannot be read",
        where=f"--crop {text}",
        expected="six numbers xmin,ymin,zmin,xmax,ymax,zmax, or a text file with at least three "
        "corners of a polygon, one `x,y` per line",
        found=found,
        todo="give the numbers in the coordinates of the exported file",
    )


def with_degree(gaussians: Gaussians, degree: int | None) -> Gaussians:
    """Return the Gaussians with the bands of spherical harmonics up to a degree; None keeps all."""
    if degree is None or gaussians.sh_rest is None or degree >= gaussians.sh_degree:
        return gaussians
    rest = gaussians.sh_rest[:, : (degree + 1) ** 2 - 1] if degree else None
    return replace(gaussians, sh_rest=rest, sh_degree=degree)


def upright(placed: Placed, up: NDArray[np.float64], axis: str, coordinates: str) -> Placed:
    """Return the content of a file, rotated so that an axis of the file points up.

    Args:
        placed: Gaussians in the coordinates of the file.
        up: [3] unit vector that points up, local frame.
        axis: `y`, `z`, or `input`, which changes nothing.
        coordinates: The coordinates of the file.

    Raises:
        UserError: The coordinates are map coordinates, whose axes have a fixed meaning.
    """
    if axis == INPUT:
        return placed
    if coordinates not in {INPUT, LOCAL, "enu"}:
        raise UserError(
            "map coordinates cannot be rotated: their axes are east, north and height",
            where=f"--up {axis}",
            expected="--up input, or --coordinates input, local or enu",
            found=f"--coordinates {coordinates}",
            todo="leave --up out, or export in enu coordinates",
        )
    turn = rotation_between(placed.rotation @ up, np.eye(3)["xyz".index(axis)])
    matrix = np.eye(4)
    matrix[:3, :3] = turn.T
    facts: dict[str, Json] = {"coordinates": coordinates, **placed.facts, "up": axis}
    for name in ("transform", "to_input"):
        if name in facts:
            known: Any = facts[name]
            facts[name] = _nested(np.array(known) @ matrix)
        elif name == "to_input" and coordinates == INPUT:
            facts[name] = _nested(matrix)
    return replace(
        placed,
        gaussians=placed.gaussians.rotated(torch.from_numpy(turn)),
        similarity=Similarity(turn @ placed.similarity.offset, placed.similarity.scale),
        facts=facts,
        rotation=turn @ placed.rotation,
        to_ecef=None if placed.to_ecef is None else placed.to_ecef @ matrix,
    )


def _nested(matrix: NDArray[np.float64]) -> Json:
    rows: Json = matrix.tolist()
    return rows


def rotation_between(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation [3, 3] that maps a unit vector [3] to another one.

    Opposite vectors are rotated by 180 degrees about the x axis, or the y axis for vectors along x.
    """
    axis, cosine = np.cross(start, end), float(start @ end)
    if cosine < -1.0 + 1e-12:
        other = np.eye(3)[int(abs(start[0]) > 0.5)]  # noqa: PLR2004
        across = other - start * (start @ other)
        across /= np.linalg.norm(across)
        return np.asarray(2.0 * np.outer(across, across) - np.eye(3))
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + cosine))


def camera_in(camera: Camera, rotation: NDArray[np.float64]) -> Camera:
    """Return a camera of the local frame in a frame that is rotated by `rotation` [3, 3]."""
    pose = camera.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ torch.from_numpy(rotation).T
    return replace(camera, world_to_camera=pose)


def most_important(
    setup: Setup, gaussians: Gaussians, views: Sequence[View], number: int
) -> Tensor:
    """Return [N] bool, True for the Gaussians that contribute most to the photos of the views.

    The contribution is the sum of a Gaussian's blending weights over all pixels of all views. It is
    the gradient of the sum of an image with respect to the Gaussian's colour.
    """
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    with torch.enable_grad():
        colors = torch.zeros((len(gaussians), 3), device=setup.device, requires_grad=True)
        moved = gaussians.mapped(lambda tensor: tensor.to(setup.device))
        drawn = replace(moved, colors=colors, sh_dc=None, sh_rest=None, sh_degree=0)
        background = torch.zeros(3, device=setup.device)
        for view in views:
            image = setup.rasterizer.render(drawn, view.camera, background).image
            (weights,) = torch.autograd.grad(image[..., 0].sum(), colors)
            total += weights[:, 0].double().cpu()
    rows = torch.zeros(len(gaussians), dtype=torch.bool)
    rows[total.argsort(descending=True, stable=True)[:number]] = True
    return rows
