"""The model of the scene: georegistered, and merged with models that GPS connects."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import write_atomically
from crossgrad_plugins.prepare.earth import local_positions, origin_of, top_of
from crossgrad_plugins.prepare.georegister import Placement, centers_of, merged, placement_of
from crossgrad_plugins.prepare.layout import Layout, emptied, scratch_of
from crossgrad_plugins.prepare.plan import Plan
from crossgrad_plugins.prepare.pycolmap_calls import write_model

if TYPE_CHECKING:
    import pycolmap

_FILE: Final = "placed.json"
#: This percentile of the heights of the points is the height of the ground.
_GROUND: Final = 5.0


@dataclass(frozen=True)
class Part:
    """A model after mapping.

    Attributes:
        photos: Names of the model's photos.
        points: Number of the model's points.
        error: Mean reprojection error in pixels.
        unplaced: Reason why the model has no position on Earth, or an empty text.
        joined: True if the model is part of the scene: the largest model, or a model that GPS
            connects with it.
        heights: Name of a photo -> height above ground, m; empty if the model has no position on
            Earth.
    """

    photos: tuple[str, ...]
    points: int
    error: float
    unplaced: str
    joined: bool
    heights: Mapping[str, float]


@dataclass(frozen=True)
class Result:
    """The content of a scene.

    Attributes:
        parts: The models, largest first.
        georef: Position of the scene on Earth, as in georef.json; None if unknown.
        figures: Number of registered photos, points and observations, and errors, of the scene's
            model.
    """

    parts: tuple[Part, ...]
    georef: dict[str, Any] | None
    figures: dict[str, float]


def placed(layout: Layout, plan: Plan, models: "Sequence[pycolmap.Reconstruction]") -> Result:
    """Georegister the models, merge models that GPS connects, and write the scene's model.

    Raises:
        UserError: The disk is full.
    """
    if not layout.placed.is_dir():
        _place(layout, plan, models)
    content = json.loads((layout.placed / _FILE).read_bytes())
    return Result(
        tuple(Part(**part) for part in content["parts"]), content["georef"], content["figures"]
    )


def _place(layout: Layout, plan: Plan, models: "Sequence[pycolmap.Reconstruction]") -> None:
    positions = local_positions(plan)
    tops = {photo.name: top_of(photo.orientation) for photo in plan.used}
    outcomes = [placement_of(model, positions, tops) for model in models]
    for model, (placement, _) in zip(models, outcomes, strict=True):
        if placement is not None:
            model.transform(placement.similarity)
    on_earth = outcomes[0][0] is not None
    joined = [
        i == 0 or (on_earth and placement is not None) for i, (placement, _) in enumerate(outcomes)
    ]
    others = [model for model, inside in zip(models[1:], joined[1:], strict=True) if inside]
    whole = merged(models[0], others) if others else models[0]
    whole.update_point_3d_errors()
    parts = [
        _part(model, placement, why, inside)
        for model, (placement, why), inside in zip(models, outcomes, joined, strict=True)
    ]
    placements = [
        placement
        for (placement, _), inside in zip(outcomes, joined, strict=True)
        if inside and placement
    ]
    result = {
        "parts": [vars(part) for part in parts],
        "georef": _georef(plan, placements) if on_earth else None,
        "figures": _figures(whole),
    }
    scratch = emptied(scratch_of(layout.placed))
    write_model(whole, scratch)
    write_atomically(scratch / _FILE, json.dumps(result).encode())
    scratch.replace(layout.placed)


def _part(
    model: "pycolmap.Reconstruction", placement: Placement | None, why: str, joined: bool
) -> Part:
    names = tuple(sorted(model.image(number).name for number in model.reg_image_ids()))
    error = float(model.compute_mean_reprojection_error())
    heights = {} if placement is None else _heights(model)
    return Part(names, model.num_points3D(), error, why, joined, heights)


def _heights(model: "pycolmap.Reconstruction") -> dict[str, float]:
    """Return the height above ground of each photo in metres, by name; z must point up."""
    points: NDArray[np.float64] = np.array([point.xyz for point in model.points3D.values()])
    if not len(points):
        return {}
    ground = float(np.percentile(points[:, 2], _GROUND))
    return {name: float(center[2]) - ground for name, center in centers_of(model).items()}


def _figures(model: "pycolmap.Reconstruction") -> dict[str, float]:
    return {
        "registered": model.num_reg_images(),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "track_length": float(model.compute_mean_track_length()),
        "reprojection_error_px": float(model.compute_mean_reprojection_error()),
    }


def _georef(plan: Plan, placements: Sequence[Placement]) -> dict[str, Any]:
    """Return the position of the scene on Earth: metres east, north and up of the origin."""
    origin = origin_of(plan)
    assert origin is not None
    residuals = {
        name: residual for placement in placements for name, residual in placement.residuals.items()
    }
    lengths = np.array([np.linalg.norm(residual) for residual in residuals.values()])
    level = np.array([np.linalg.norm(residual[:2]) for residual in residuals.values()])
    height = np.array([abs(residual[2]) for residual in residuals.values()])
    agreeing = frozenset[str]().union(*(placement.agreeing for placement in placements))
    return {
        "origin": origin.model_dump(),
        "transform": np.eye(4).tolist(),
        "frame": "scene -> metres east, north, up of the origin (WGS 84)",
        "residuals_m": {
            "photos": len(lengths),
            "agreeing": len(agreeing),
            "median": float(np.median(lengths)),
            "rms": float(np.sqrt(np.mean(lengths**2))),
            "max": float(lengths.max()),
            "rms_horizontal": float(np.sqrt(np.mean(level**2))),
            "rms_vertical": float(np.sqrt(np.mean(height**2))),
            "per_photo": {name: [round(float(v), 3) for v in residual]
                          for name, residual in sorted(residuals.items())},
        },
    }  # fmt: skip
