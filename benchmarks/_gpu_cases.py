"""The cases of benchmarks/gpu.py, and the stops of its long runs."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

#: The last one is the readable reference: it takes part where K is 1, for comparison.
RASTERIZERS = ("gsplat", "gswarp", "torch")
BACKBONES = ("vanilla", "pixel", "mip", "distance", "scaffold", "octree")
VIEWS = (1, 2, 4, 8)
OPERATORS = ("sum", "mean", "pcgrad", "cagrad", "upgrad", "symmetric")
#: Gaussians of the made-up clouds, and megapixels of their photos.
SIZES, PIXELS = (100_000, 1_000_000, 3_000_000), 1.0
#: Lengths of runs with the settings that `crossgrad run` has if nothing is asked.
USUAL = (1_000, 7_000, 30_000)
#: Steps of a long run that have a row, beside its last.
STOPS = (7_000, 15_000)


@dataclass(frozen=True)
class Case:
    """One row.

    Attributes:
        part: `sizes`, `steps`, `long` or `usual`.
        rasterizer: Its name.
        backbone: Its name.
        views: K.
        operator: Its name.
        steps: How many are measured.
        gaussians: Of a made-up cloud; 0 for SCENE.
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
        """The folder of its runs."""
        split = ("every",) if self.part in {"long", "usual"} else ()
        return "-".join(map(str, (*vars(self).values(), *split)))

    def command(self, scene: Path, out: Path) -> list[str]:
        """The command that trains a run of the parts `long` and `usual`."""
        options = {
            "--device": "cuda",
            "--rasterizer": self.rasterizer,
            "--backbone": self.backbone,
            "--views": self.views,
            "--operator": self.operator,
            "--steps": self.steps,
            "--metrics": "psnr",
            "--out": out,
            "--split": "every",  # As gsplat's trainer has it, where photos lie in one folder.
            "--eval-every": max(1, min(1_000, self.steps // 7)),
        }
        if self.part == "long":
            options |= {"--sampler": "random", "--schedule": "absolute"}
        given = [str(part) for pair in options.items() for part in pair]
        return [sys.executable, "-m", "crossgrad_core", "run", str(scene), "-q", *given]

    def config(self, scene: Path) -> dict[str, Any]:
        """The settings of a case that is measured in this process."""
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
    """All rows, the short ones first."""
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
    """Whether a case has one of the texts in its name, or there is none."""
    return not only or any(text in case.name for text in only)


def stops(steps: int) -> tuple[int, ...]:
    """The steps of a long run whose figures are in the table."""
    return (*(stop for stop in STOPS if stop < steps), steps)
