"""The cases of benchmarks/gpu.py, and the evaluated steps of its long runs."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

#: The last rasterizer is the reference in plain torch. The reference is measured only for K = 1.
RASTERIZERS = ("gsplat", "gswarp", "torch")
BACKBONES = ("vanilla", "pixel", "mip", "distance", "scaffold", "octree")
VIEWS = (1, 2, 4, 8)
OPERATORS = ("sum", "mean", "pcgrad", "cagrad", "upgrad", "symmetric")
#: Numbers of Gaussians in the random clouds, and number of megapixels of their photos.
SIZES, PIXELS = (100_000, 1_000_000, 3_000_000), 1.0
#: Lengths of runs with the default settings of `crossgrad run`.
USUAL = (1_000, 7_000, 30_000)
#: Steps of a long run that get a row in the table, besides the last step.
STOPS = (7_000, 15_000)


@dataclass(frozen=True)
class Case:
    """A measured case: one row of the table.

    Attributes:
        part: `sizes`, `steps`, `long` or `usual`.
        rasterizer: Name of the rasterizer.
        backbone: Name of the backbone.
        views: Number K of views per step.
        operator: Name of the operator.
        steps: Number of measured steps.
        gaussians: Number of Gaussians of a random cloud; 0 for the scene of the command line.
    """

    part: str
    rasterizer: str
    backbone: str
    views: int
    operator: str
    steps: int
    gaussians: int = 0

    @property
    def name(self) -> str:
        """The name of the folder with the runs of the case."""
        split = ("every",) if self.part in {"long", "usual"} else ()
        return "-".join(map(str, (*vars(self).values(), *split)))

    def command(self, scene: Path, out: Path) -> list[str]:
        """Return the command that trains a run of the parts `long` and `usual`."""
        options = {
            "--device": "cuda",
            "--rasterizer": self.rasterizer,
            "--backbone": self.backbone,
            "--views": self.views,
            "--operator": self.operator,
            "--steps": self.steps,
            "--metrics": "psnr",
            "--out": out,
            # If all photos are in one folder, gsplat holds out the same photos as crossgrad.
            "--split": "every",
            "--eval-every": max(1, min(1_000, self.steps // 7)),
        }
        if self.part == "long":
            options |= {"--sampler": "random", "--schedule": "absolute"}
        given = [str(part) for pair in options.items() for part in pair]
        return [sys.executable, "-m", "crossgrad_core", "run", str(scene), "-q", *given]

    def config(self, scene: Path) -> dict[str, Any]:
        """Return the settings of a case that is measured in this process."""
        return {
            "scene": str(scene),
            "device": "cuda",
            "rasterizer": {"name": self.rasterizer},
            "backbone": {"name": self.backbone},
            "sampler": {"name": "random"},
            "views_per_step": self.views,
            "operator": {"name": self.operator},
            "steps": 30_000,
            "schedule": "absolute",
            "growth": "unbounded",
            "schedule_unit": "steps",
        }


def cases(steps: int, long: int) -> Iterator[Case]:
    """Yield all rows, the short cases first."""
    fast = RASTERIZERS[:-1]
    for rasterizer, count in product(fast, SIZES):
        for views, operator in ((1, "sum"), (2, "pcgrad")):
            yield Case("sizes", rasterizer, "vanilla", views, operator, steps, count)
    for rasterizer, backbone in product(RASTERIZERS, BACKBONES):
        yield Case("steps", rasterizer, backbone, 1, "sum", steps)
    for rasterizer, views, operator in product(fast, VIEWS[1:], OPERATORS):
        yield Case("steps", rasterizer, "vanilla", views, operator, steps)
    for rasterizer, views in product(fast, VIEWS[:2]):
        yield Case("long", rasterizer, "vanilla", views, "sum", long)
    for rasterizer, length in product(fast, USUAL):
        yield Case("usual", rasterizer, "vanilla", 1, "sum", length)


def is_chosen(case: Case, only: Sequence[str] | None) -> bool:
    """Return True if a case's name contains one of the texts, or if there are no texts."""
    return not only or any(text in case.name for text in only)


def stops(steps: int) -> tuple[int, ...]:
    """Return the steps of a long run that get a row in the table."""
    return (*(stop for stop in STOPS if stop < steps), steps)
