"""Measure the viewer: the time of frames, and the cost for a run with and without a page.

    python benchmarks/view.py frames [--gaussians N]   # still and moving frames of random Gaussians
    python benchmarks/view.py training [--steps N]     # CPU and training seconds of short runs

A client without a browser connects. It moves its camera all the time. Training is measured in
CPU seconds of the whole process over the same steps, because other programs may use the machine.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from threading import Thread
from time import monotonic, perf_counter, process_time, sleep

import torch
from websockets.exceptions import WebSocketException

from crossgrad_core.config import ComponentChoice
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Similarity
from crossgrad_core.plugin import Rasterizer, build_component
from crossgrad_core.run import app
from crossgrad_core.run.results.summary import read_summary
from crossgrad_plugins.view.app import serve, warm_up
from crossgrad_plugins.view.cameras import free_camera
from crossgrad_plugins.view.server import Viewer
from crossgrad_plugins.view.session import Stage
from crossgrad_plugins.view.sources import Source

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.viewer_client import window

SIZE, FOV, SEED = (1280, 720), 0.8, 0
PORT = 8177


def random_gaussians(number: int) -> Gaussians:
    """Return Gaussians of SH degree 3 in a ball, about as large as in a trained scene."""
    random = torch.Generator().manual_seed(SEED)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random)

    return Gaussians(
        means=normal(number, 3) * 0.5,
        quats=normal(number, 4),
        scales=torch.exp(normal(number, 3) * 0.5 - 6.0),
        opacities=torch.rand(number, generator=random),
        sh_dc=torch.rand(number, 1, 3, generator=random),
        sh_rest=normal(number, 15, 3) * 0.05,
        sh_degree=3,
    )


def measure_frames(number: int) -> None:
    """Print seconds until a still frame arrives, and frames per second of a moving camera."""
    rasterizer = build_component(Rasterizer, "numba", {})
    similarity = Similarity(torch.zeros(3).double().numpy(), 1.0)
    source = Source.of_gaussians("random", random_gaussians(number), similarity, rasterizer)
    stage = Stage(lambda: [source], similarity)
    warm_up(stage)
    viewer = Viewer(stage, port=0)
    Thread(target=serve, args=(viewer,), daemon=True).start()
    camera = free_camera()
    with window(viewer.url) as page:
        page.open(camera, FOV, SIZE)
        page.still()
        waits, cpu = [], []
        for turn in range(5):
            begun, worked = perf_counter(), process_time()
            page.look(camera, FOV + 0.01 * turn, SIZE)
            assert page.still().shape == (720, 1280, 3)
            waits.append(perf_counter() - begun)
            cpu.append(process_time() - worked)
        print(f"still frame {SIZE}: {median(waits):.2f} s, {median(cpu):.2f} CPU s of all threads")
        page.frames.clear()
        begun, worked = perf_counter(), process_time()
        while perf_counter() - begun < 5.0:
            page.look(camera, FOV + 0.001 * (perf_counter() - begun), SIZE)
            page.take(0.02)
        sizes = [image.shape[:2] for _, image in page.frames]
        used = (process_time() - worked) / len(sizes)
        print(
            f"moving: {len(sizes) / 5:.1f} frames per second, last size {sizes[-1][::-1]}, "
            f"{used:.3f} CPU s per frame"
        )


def move_camera() -> None:
    """Move the camera of a page until the viewer has ended; runs in a process of its own."""
    while True:
        try:
            with window(f"http://127.0.0.1:{PORT}") as page:
                begun = monotonic()
                while True:
                    page.look(free_camera(), FOV + 0.001 * (monotonic() - begun), SIZE)
                    page.take(0.02)
        except (OSError, WebSocketException):  # The viewer has not started yet, or has ended.
            sleep(0.1)


def train(steps: int, *, viewer: bool, moves: bool) -> tuple[float, float]:
    """Return CPU seconds of the whole run in this process, and those of its training steps."""
    choice = ComponentChoice.model_validate({"name": "view", "port": PORT}) if viewer else None
    page = subprocess.Popen([sys.executable, __file__, "page"]) if moves else None
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        settings = {"out": str(out), "steps": steps, "plan": "off", "max_gaussians": 60_000}
        worked = process_time()
        app.run(settings, verbosity=-1, viewer=choice)
        cpu = process_time() - worked
        if page is not None:
            page.kill()
            page.wait()
        return cpu, read_summary(out)["cpu_seconds"]


def measure_training(steps: int, rounds: int) -> None:
    """Print the CPU seconds of training with a viewer, relative to a run without one.

    The whole run counts, because drawing is no training time. Its evaluation and export are the
    same in every run, so that they cancel in the difference.
    """
    kinds = {
        "no viewer": {"viewer": False, "moves": False},
        "no page": {"viewer": True, "moves": False},
        "moving page": {"viewer": True, "moves": True},
    }
    train(20, viewer=False, moves=False)
    taken: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
    for _ in range(rounds):
        for kind, options in kinds.items():
            taken[kind].append(train(steps, **options))
    for kind, rows in taken.items():
        pairs = zip(rows, taken["no viewer"], strict=True)
        ratios = [1.0 + (mine[0] - plain[0]) / plain[1] for mine, plain in pairs]
        print(f"{kind:12} {median(ratios):.3f} ({', '.join(f'{ratio:.3f}' for ratio in ratios)})")


def main() -> None:
    """Run the chosen measurement."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=("frames", "training", "page"))
    parser.add_argument("--gaussians", type=int, default=500_000)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    if given.what == "page":
        move_camera()
    elif given.what == "frames":
        measure_frames(given.gaussians)
    else:
        measure_training(given.steps, given.rounds)


if __name__ == "__main__":
    main()
