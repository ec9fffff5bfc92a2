"""Every number that a run decides by itself, for 500 combinations of what it decides them from.

    python -m support.decided        # in tests/; a change of a decided number is a decision

writes integration/data/decided.json. Nothing is trained.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.georeference import Similarity
from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import entries
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import redecided
from crossgrad_core.run.resolve import resolved
from crossgrad_core.training.budget import with_length
from crossgrad_core.training.growth_budget import most_after
from crossgrad_core.training.rates import axes_of, rates_at, rule_at
from crossgrad_core.training.setup import Setup

PATH = Path(__file__).parents[1] / "integration" / "data" / "decided.json"
COMBINATIONS, SEED = 500, 54
#: Steps, views or seconds of a run; of one within seconds also the steps that it turns out to have.
LENGTHS: tuple[Mapping[str, Any], ...] = (
    {"steps": 30},
    {"steps": 500},
    {"steps": 2_999},
    {"steps": 7_000},
    {"steps": 15_000},
    {"steps": 29_999},
    {"steps": 30_000},
    {"steps": 60_000},
    {"max_views": 1_200},
    {"max_views": 29_999},
    {"seconds": 60.0, "planned": 700},
    {"seconds": 600.0, "planned": 9_000},
)
VIEWS = (1, 2, 3)
PHOTOS = ((12, 400 * 300), (99, 640 * 400), (100, 640 * 400), (300, 800 * 600))
#: Settings on top, one of them in each combination.
EXTRAS: tuple[Mapping[str, Any], ...] = (
    {},
    {"recipe": {"name": "published"}},
    {"schedule": "absolute"},
    {"schedule": "absolute", "schedule_length": 7_000},
    {"batch_rule": "sqrt"},
    {"max_gaussians": 50_000},
    {"growth": "unbounded"},
    {"rules": {"sparse-sh": {"every": 2}}},
)
DEVICES = ("cpu", "cuda")
#: Primitives at the start, for the budget.
STARTS = (1_000, 20_000)
#: The settings of config.yaml that a run decides where the user names nothing.
DECIDED = (
    *(
        "densifier",
        "rasterizer",
        "initializer",
        "resolution",
        "views_per_step",
        "steps",
        "schedule_unit",
    ),
    *("rules", "growth", "max_gaussians"),
)


class _Blank:
    """A photo that nothing decodes."""

    def image(self) -> torch.Tensor:
        raise AssertionError("no decision may decode a photo")

    def mask(self) -> None:
        return None


@cache
def scene_of(photos: int, pixels: int) -> Scene:
    """A ring of cameras around 500 points, each of which all photos observe."""
    rng = np.random.default_rng(photos)
    width = round((pixels * 4 / 3) ** 0.5)
    points = rng.normal(size=(500, 3)) * 0.2

    def view(index: int) -> View:
        angle = 2 * np.pi * index / photos
        forward = -np.array([np.cos(angle), np.sin(angle), 0.0])
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[2, 3] = 1.0
        height = pixels // width
        camera = Camera(
            *(width, height, float(width), float(width), width / 2, height / 2),
            world_to_camera=torch.from_numpy(pose),
        )
        return View(f"{index:04d}.jpg", camera, _Blank(), "all", np.arange(500))

    views = tuple(map(view, range(photos)))
    return Scene(
        name="ring",
        views=views,
        train=tuple(range(photos)),
        test=(),
        points=points,
        point_colors=np.full((500, 3), 128, np.uint8),
        similarity=Similarity(np.zeros(3), 1.0),
    )


def combinations() -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Name and settings of each combination, the same ones in every process."""
    backbones, densifiers = entries("backbones"), (None, *entries("densifiers"))
    every = [*product(backbones, densifiers, LENGTHS, VIEWS, PHOTOS, EXTRAS, DEVICES)]
    for row in np.random.default_rng(SEED).permutation(len(every))[:COMBINATIONS]:
        backbone, densifier, length, views, photos, extra, device = every[row]
        chosen = {
            "backbone": {"name": backbone},
            "densifier": None if densifier is None else {"name": densifier},
            **length,
            "views": views,
            "photos": photos,
            **extra,
            "device": device,
        }
        yield json.dumps({k: v for k, v in chosen.items() if v is not None}), chosen


def decided(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """The decided numbers of one combination, or why it is refused."""
    given = dict(settings)
    scene, planned = scene_of(*given.pop("photos")), given.pop("planned", None)
    given["views_per_step"] = given.pop("views")
    config = RunConfig.model_validate({**given, "plan": "off", "exposure": {"name": "none"}})
    device = torch.device(config.device)
    try:
        with (
            patch("crossgrad_core.run.assemble.choose_device", lambda _: device),
            patch("crossgrad_core.run.select.choose_device", lambda _: device),
        ):
            setup = assemble(config, scene, "colmap")
    except UserError as error:
        return {"refused": error.what}
    if planned is not None:
        timed = replace(setup, config=setup.config.model_copy(update={"steps": planned}))
        setup = with_length(redecided(timed, planned), 0, planned)
    return {
        "settings": json.loads(resolved(setup).model_dump_json(include=set(DECIDED))),
        "schedule": _schedule(setup),
        "rates": {step: rates_at(setup, step) for step in _steps(setup)},
        "adam": {step: repr(rule_at(setup, step)) for step in _steps(setup)},
        "axes": axes_of(setup),
        "growth": setup.numbers.growth,
        "bound": setup.numbers.max_gaussians,
        "budget": _budget(setup),
        "pixels": setup.selection.resolution.pixels(setup.schedule, setup.schedule.total),
    }


def _steps(setup: Setup) -> tuple[int, ...]:
    total = setup.schedule.total
    return tuple(sorted({1, max(1, total // 2), max(1, round(0.9 * total)), total}))


def _schedule(setup: Setup) -> Mapping[str, Any]:
    schedule = setup.schedule
    names = (
        *("mode", "total", "length", "lr_until", "sh_interval", "sh_from", "sh_wait"),
        *("densify_from", "densify_until", "densify_every", "reset_every", "min_refinements"),
        *("anchors_from", "anchors_every", "coarse_until"),
    )
    return {name: getattr(schedule, name) for name in names} | {"edits": schedule.edits()}


def _budget(setup: Setup) -> list[int] | None:
    steps = setup.schedule.edit_steps()
    if not steps or (setup.numbers.growth == "unbounded" and setup.numbers.max_gaussians != "auto"):
        return None
    shown = (steps[0], steps[len(steps) // 2], steps[-1])
    return [most_after(setup, setup.schedule, step, start) for start in STARTS for step in shown]


def as_json(numbers: Mapping[str, Any]) -> str:
    """One line for each combination, so that a change of one shows as one line."""
    return json.dumps(numbers, sort_keys=True)


def main() -> None:
    """Write down what is decided now."""
    rows = (f"{json.dumps(name)}: {as_json(decided(chosen))}" for name, chosen in combinations())
    PATH.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
