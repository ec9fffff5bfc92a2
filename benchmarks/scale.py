"""Measure step time and peak memory by number of Gaussians, image size, K and threads.

    python benchmarks/scale.py [--full] [--only TEXT] [--reps N] [--out DIR]

The scene is synthetic and in memory. Cameras are in the middle of the scene and look in one
direction or in ten directions. Each camera sees a cloud of Gaussians in front of it. All other
Gaussians are outside all views. A case `fixed` has one direction, so that each step sees the same
Gaussians. A case `turning` has ten directions, with a tenth of all Gaussians in each. In a case
`turning`, each Gaussian is out of view for ten steps on average, and its deferred updates are done
later. Measured steps are during density control, between two edits, with SH degree 3.

Times are CPU seconds. The cases of a group take alternate steps in one process. Ratios are medians
over pairs of steps with the group's first case. Memory is the peak resident memory of a separate
process, including the copy for rollback. The bound is the time that memory traffic alone would
take. The bound assumes that a step moves every number once, with the bandwidth of a copy on this
machine.

With `--out`, the program writes scale.json and scale.svg.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from _machine import code, facts, peak_mib
from torch import Tensor

from crossgrad_core.numerics.threads import configure_threads

if TYPE_CHECKING:
    from crossgrad_core.contract.scene import Scene, View
    from crossgrad_core.training.setup import Setup
    from crossgrad_core.training.state import TrainState

#: A step of the published schedule with SH degree 3 that collects statistics and is far from an
#: edit.
STEP = 5_010
#: A step in which density control edits the primitives.
EDIT = 5_100
#: Number of steps before the measurement. They compile kernels, decode photos and fill memory.
WARM_UP = 3
#: Number of photos in each direction.
PHOTOS = 4
#: Number of bytes that a step moves per Gaussian of SH degree 3. The first value is for a Gaussian
#: that is not rendered: 11 geometry parameters and their moments are read and written. The second
#: value is for a rendered Gaussian: 59 parameters with their moments and gradients.
UNSEEN, SEEN = 11 * 6 * 4, 59 * 8 * 4


@dataclass(frozen=True)
class Cell:
    """A measured case.

    Attributes:
        gaussians: Number of all Gaussians.
        visible: Number of Gaussians in front of each camera.
        pixels: Megapixels of a photo.
        views: K.
        operator: Name of the operator.
        directions: Number of directions in which cameras look.
        threads: Threads of the process.
    """

    gaussians: int
    visible: int
    pixels: float = 0.12
    views: int = 1
    operator: str = "sum"
    directions: int = 1
    threads: int = 1

    @property
    def name(self) -> str:
        """A short name."""
        way = "turning" if self.directions > 1 else "fixed"
        return (
            f"{way}, {self.visible:,} of {self.gaussians:,}, {self.pixels:g} MP, "
            f"K = {self.views} {self.operator}, threads {self.threads}"
        )

    @property
    def bytes(self) -> int:
        """Minimum number of bytes that a step must move."""
        drawn = min(self.gaussians, self.visible * min(self.views, self.directions))
        return UNSEEN * (self.gaussians - drawn) + SEEN * drawn


@dataclass(frozen=True)
class Noise:
    """A photo of random pixels.

    Attributes:
        seed: Seed of the pixels.
        width: Width in pixels.
        height: Height in pixels.
    """

    seed: int
    width: int
    height: int

    def image(self) -> Tensor:
        """Return the pixels [H, W, 3] uint8."""
        rng = np.random.default_rng(self.seed)
        return torch.from_numpy(rng.integers(0, 256, (self.height, self.width, 3), np.uint8))

    def mask(self) -> Tensor | None:
        """Return None: every pixel counts."""
        return None


def groups(*, full: bool) -> Iterator[tuple[str, list[Cell]]]:
    """Yield the title and the cases of each group.

    The cases are compared with the first case of their group.
    """
    base = Cell(20_000, 20_000)
    yield "unseen", [base, replace(base, gaussians=200_000)]
    yield "turning", [base, replace(base, gaussians=200_000, directions=10)]
    if not full:
        return
    counts = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)
    yield "gaussians", [replace(base, gaussians=n, visible=10_000) for n in counts]
    yield "megapixels", [replace(base, pixels=p) for p in (0.05, 0.12, 0.5, 2.0, 12.0)]
    ways = ((1, "sum"), (2, "sum"), (4, "sum"), (2, "pcgrad"), (4, "pcgrad"))
    yield "views", [replace(base, views=k, operator=o) for k, o in ways]
    yield "threads", [base, replace(base, threads=2)]


def memory_cells(*, full: bool) -> Iterator[tuple[Cell, bool]]:
    """Yield the cases of the memory measurement as pairs of a cell and a flag.

    The flag is True if density control edits the Gaussians in the last step.
    """
    count = 1_000_000 if full else 200_000
    pair = Cell(count, count, views=2, operator="pcgrad")
    for cell in (pair, replace(pair, visible=count // 10)):
        yield cell, False
        yield cell, True


def scene_of(cell: Cell) -> "Scene":
    """Return the scene of a cell."""
    from crossgrad_core.contract.georeference import Similarity
    from crossgrad_core.contract.scene import Scene

    width = round((cell.pixels * 1e6 * 4 / 3) ** 0.5)
    size = (width, round(width * 3 / 4))
    views = [_view(d, k, size) for d in range(cell.directions) for k in range(PHOTOS)]
    points = _points(cell)
    return Scene(
        name="scale",
        views=tuple(views),
        train=tuple(range(len(views))),
        test=(),
        points=points,
        point_colors=np.random.default_rng(1).integers(0, 256, points.shape, np.uint8),
        similarity=Similarity(np.zeros(3), 1.0),
        point_sizes=np.full(len(points), 0.3 / cell.visible**0.5),
    )


def _view(direction: int, number: int, size: tuple[int, int]) -> "View":
    """Return photo `number` of a direction, with a camera slightly shifted from the others."""
    from crossgrad_core.contract.scene import Camera, View

    pose = np.eye(4)
    pose[:3, :3] = _turn(2 * np.pi * direction / 10).T
    pose[:3, 3] = -pose[:3, :3] @ (0.01 * np.array([number, 0.5 * number, 0.0]))
    # The field of view is 30 degrees, so that ten directions do not overlap.
    focal = 0.5 * size[0] / np.tan(np.deg2rad(15))
    calibration = (focal, focal, size[0] / 2, size[1] / 2)
    camera = Camera(*size, *calibration, torch.from_numpy(pose))
    seed = direction * PHOTOS + number
    photo = Noise(seed, *size)
    return View(f"{seed:04}.png", camera, photo, "all", np.zeros(0, np.int64))


def _turn(angle: float) -> np.ndarray:
    """Return a camera-to-world rotation [3, 3] about y, for x right, y down, z forward."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _points(cell: Cell) -> np.ndarray:
    """Return points [N, 3] in random order: clouds in all directions, and unseen points."""
    rng = np.random.default_rng(0)
    tan = np.tan(np.deg2rad(14))
    depth = rng.uniform(1.0, 2.0, cell.gaussians)
    flat = rng.uniform(-tan, tan, (cell.gaussians, 2)) * depth[:, None] * [1.0, 0.75]
    local = np.column_stack([flat, depth])
    direction = np.arange(cell.gaussians) // cell.visible
    angles = 2 * np.pi * direction / 10
    # With one direction, the other clouds are behind the camera. With ten directions, each cloud is
    # seen by a photo.
    if cell.directions == 1:
        angles = np.where(direction > 0, np.pi, 0.0)
    c, s = np.cos(angles), np.sin(angles)
    world = np.column_stack(
        [c * local[:, 0] + s * local[:, 2], local[:, 1], c * local[:, 2] - s * local[:, 0]]
    )
    return np.asarray(world[rng.permutation(cell.gaussians)])


def setup_of(cell: Cell, **options: object) -> "Setup":
    """Return the setup of a cell, with further options."""
    from crossgrad_core.commands import assemble, configured

    config = configured(
        {
            "scene": "examples/scenes/boruszyn",
            "threads": cell.threads,
            "steps": 30_000,
            "schedule": "absolute",
            "views_per_step": cell.views,
            "backbone": {"name": "vanilla", "sh_degree": 3},
            "sampler": {"name": "random"},
            "operator": {"name": cell.operator},
            "densifier": {"name": "adc"},
            "max_gaussians": cell.gaussians,
            "growth": "unbounded",
            "schedule_unit": "steps",
            # Turn dropout off, so that each photo renders all Gaussians in front of its camera.
            "rules": {"dropout": False},
            **options,
        }
    )
    return assemble(config, scene_of(cell), "colmap")


class Run:
    """A run during density control.

    Args:
        cell: The case.
        options: Further options of the run.
    """

    def __init__(self, cell: Cell, **options: object) -> None:
        from crossgrad_core.commands import begin
        from crossgrad_core.training.state import RollbackGuard

        self.setup = setup_of(cell, **options)
        self.state: TrainState = begin(self.setup)
        self.state.step = STEP
        self.guard = RollbackGuard(self.state)

    def step(self) -> tuple[float, float]:
        """Take a step, and return its CPU seconds and wall seconds."""
        from crossgrad_core.training.loop import timed_step

        cpu, wall = process_time(), perf_counter()
        timed_step(self.setup, self.state)
        return process_time() - cpu, perf_counter() - wall


def timed(title: str, cells: list[Cell], reps: int) -> Iterator[dict[str, Any]]:
    """Yield the medians of a group's cases, which take alternate steps."""
    configure_threads(max(cell.threads for cell in cells))
    runs = [Run(cell) for cell in cells]
    seconds: list[list[tuple[float, float]]] = [[] for _ in runs]
    for repetition in range(reps + WARM_UP):
        for cell, run, found in zip(cells, runs, seconds, strict=True):
            configure_threads(cell.threads)
            took = run.step()
            if repetition >= WARM_UP:
                found.append(took)
    speed = bandwidth()
    for cell, found in zip(cells, seconds, strict=True):
        yield {
            "group": title,
            "cell": asdict(cell),
            "name": cell.name,
            "cpu_seconds": median(cpu for cpu, _ in found),
            "wall_seconds": median(wall for _, wall in found),
            "ratio": median(a[0] / b[0] for a, b in zip(found, seconds[0], strict=True)),
            "bound_seconds": cell.bytes / speed,
        }


def bandwidth() -> float:
    """Return the bytes per second of CPU time that a copy reads and writes."""
    source = np.ones(1 << 24)
    target = np.zeros_like(source)
    times = []
    for _ in range(5):
        start = process_time()
        np.copyto(target, source)
        times.append(process_time() - start)
    return 2 * source.nbytes / min(times)


def remembered(cell: Cell, *, edit: bool) -> None:
    """Print the peak memory of a few steps. This function is called in a separate process."""
    configure_threads(cell.threads)
    run = Run(cell)
    for _ in range(2):
        run.step()
    if edit:
        run.state.step = EDIT - 1
        run.step()
    kind = "edit" if edit else "step"
    line = {"group": "memory", "cell": asdict(cell), "name": cell.name, "kind": kind}
    print(json.dumps({**line, "peak_mib": peak_mib()}))


def memory(cell: Cell, *, edit: bool) -> dict[str, Any]:
    """Return the peak memory of a cell."""
    task = json.dumps({"cell": asdict(cell), "edit": edit})
    command = [sys.executable, __file__, "--task", task]
    found: dict[str, Any] = json.loads(subprocess.check_output(command, text=True))
    return found


def draw(lines: list[dict[str, Any]], path: Path) -> None:
    """Plot step time and its bound by number of Gaussians, and by pixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, group, key in zip(
        axes, ("gaussians", "megapixels"), ("gaussians", "pixels"), strict=True
    ):
        chosen = [line for line in lines if line["group"] == group]
        across = [line["cell"][key] for line in chosen]
        axis.loglog(across, [line["cpu_seconds"] for line in chosen], "o-", label="step")
        axis.loglog(across, [line["bound_seconds"] for line in chosen], "--", label="memory bound")
        axis.set_xlabel("Gaussians, 10,000 of them seen" if key == "gaussians" else "megapixels")
        axis.set_ylabel("seconds of CPU per step")
        axis.grid(visible=True, which="both", alpha=0.3)
        axis.legend()
    figure.savefig(path, metadata={"Date": None})


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--full", action="store_true", help="measure the whole table, which takes half an hour"
    )
    parser.add_argument("--only", default="", help="only groups with this in their title")
    parser.add_argument("--reps", type=int, default=15)
    parser.add_argument("--out", type=Path, help="folder for scale.json and scale.svg")
    parser.add_argument("--task", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.task:
        task = json.loads(arguments.task)
        remembered(Cell(**task["cell"]), edit=task["edit"])
        return
    lines: list[dict[str, Any]] = []
    for title, cells in groups(full=arguments.full):
        if arguments.only in title:
            lines += timed(title, cells, arguments.reps)
            show(lines[-len(cells) :])
    if arguments.only in "memory":
        for cell, edit in memory_cells(full=arguments.full):
            lines.append(memory(cell, edit=edit))
            show(lines[-1:])
    print(json.dumps({"code": code(), **facts()}))
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
        content = {"code": code(), **facts(), "lines": lines}
        (arguments.out / "scale.json").write_text(json.dumps(content, indent=1))
        draw(lines, arguments.out / "scale.svg")


def show(lines: list[dict[str, Any]]) -> None:
    """Print one line for each cell."""
    for line in lines:
        if "peak_mib" in line:
            print(f"{line['name']}, {line['kind']}: {line['peak_mib']:,.0f} MiB", flush=True)
        else:
            print(
                f"{line['group']}: {line['name']}: {1e3 * line['cpu_seconds']:.1f} ms of CPU, "
                f"{line['ratio']:.2f} times the first, bound {1e3 * line['bound_seconds']:.1f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
