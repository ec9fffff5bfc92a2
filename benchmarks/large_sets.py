"""Compare training on thousands of large photos with training on photos in memory.

    python benchmarks/large_sets.py [--photos 2000] [--max-size 1600] [--passes 2] [--block 25]
        [--distorted] [--warm] [--folder DIR]

The scene is made from the bundled scene. Its 28 photos are enlarged tenfold to 4000 x 2980 pixels,
get noise, and are saved as JPEG. Links give the requested number of names. Each name also gets a
camera, and crossgrad treats every name as a separate photo. Two processes take the same steps
(`--sampler epoch`, one view, no density control) in alternating blocks of `--block` steps. While
one process works, the other process is stopped. The first process trains on all photos. The second
process trains on only the 28 photos, which are decoded before it begins. Both processes measure
wall time, including decoding.

The program prints the seconds until the first step, the seconds per step in each pass over the
photos, and the resident memory. It also prints the ratio of the seconds of the two processes in the
same blocks. `--distorted` uses a camera with lens distortion. `--warm` starts with the decoded
photos that an earlier run with the same `--folder` stored on disk.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from time import monotonic, perf_counter
from typing import Any

import numpy as np
from _machine import code, facts

#: Factor by which the bundled photos are enlarged.
SCALE = 10
#: Standard deviation of the noise in grey levels, and JPEG quality. With these values, a file has
#: about 4 MB.
GRAIN, QUALITY = 4.0, 92
BUNDLED = Path(__file__).parents[1] / "examples" / "scenes" / "boruszyn"


def make_scene(folder: Path, photos: int, *, distorted: bool) -> None:
    """Write a COLMAP scene with this number of photos."""
    import pycolmap
    from PIL import Image

    small = pycolmap.Reconstruction(BUNDLED / "sparse" / "0")
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "originals").mkdir()
    (camera,) = small.cameras.values()
    fx, fy, cx, cy = (SCALE * float(value) for value in camera.params)
    size = camera.width * SCALE, camera.height * SCALE
    model = f"OPENCV {size[0]} {size[1]} {fx} {fy} {cx} {cy} -0.08 0.02 0 0"
    if not distorted:
        model = f"PINHOLE {size[0]} {size[1]} {fx} {fy} {cx} {cy}"
    images = sorted(small.images.values(), key=lambda image: image.name)
    for image in images:
        with Image.open(BUNDLED / "images" / image.name) as photo:
            pixels = np.asarray(photo.convert("RGB").resize(size, Image.Resampling.BICUBIC))
        noise = np.random.default_rng(image.image_id).normal(0, GRAIN, pixels.shape)
        grainy = Image.fromarray((pixels + noise).clip(0, 255).astype(np.uint8))
        grainy.save(folder / "originals" / image.name, quality=QUALITY)
    lines = []
    for number in range(photos):
        image = images[number % len(images)]
        name = f"{number:05d}.jpg"
        os.link(folder / "originals" / image.name, folder / "images" / name)
        pose = image.cam_from_world()
        x, y, z, w = pose.rotation.quat
        place = " ".join(map(str, (w, x, y, z, *pose.translation)))
        lines += [f"{number + 1} {place} 1 {name}", ""]
    sparse = folder / "sparse" / "0"
    (sparse / "cameras.txt").write_text(f"1 {model}\n")
    (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    points = small.points3D.items()
    (sparse / "points3D.txt").write_text(
        "".join(f"{n} {' '.join(map(str, (*p.xyz, *p.color)))} 0.1\n" for n, p in points)
    )


def serve(scene: Path, max_size: int, cache_mib: int) -> None:
    """Read numbers of steps from stdin, take the steps, and print their cost as JSON."""
    begun = monotonic()
    from crossgrad_core.run.load_run import set_up
    from crossgrad_core.run.settings import parsed
    from crossgrad_core.scene.photos.photos_ahead import check_photos, fits
    from crossgrad_core.training.loop import Prefetcher, timed_step
    from crossgrad_core.training.start import first_state, warm_up

    settings: dict[str, Any] = {
        "scene": str(scene),
        "steps": 30_000,
        "sampler": {"name": "epoch"},
        "densifier": {"name": "none"},
        "data": {"max_size": max_size or None, "cache_mib": cache_mib},
    }
    setup, _ = set_up(parsed(settings), -1)
    keep = fits(setup.scene, cache_mib)
    check_photos(setup.scene.views if keep else setup.scene.test_views, keep=keep)
    warm_up(setup)
    state, prefetcher = first_state(setup), Prefetcher(setup)

    def fail(error: Exception) -> None:
        raise error

    views = (*setup.train_views, *setup.scene.test_views)
    with setup.photos_ahead.at_work(views, fail, keep=keep):
        _answer(seconds=monotonic() - begun, views=len(setup.train_views))
        for line in sys.stdin:
            start, load = perf_counter(), state.clock.load
            for _ in range(int(line)):
                prefetcher.update(state)
                timed_step(setup, state)
            took, waited = perf_counter() - start, state.clock.load - load
            _answer(seconds=took, waited=waited, memory=_resident("VmRSS"), peak=_resident("VmHWM"))


def _answer(**figures: float) -> None:
    print(json.dumps(figures), flush=True)


def _resident(what: str) -> float:
    """Return memory of this process in MiB, from Linux's /proc."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what):
            return int(line.split()[1]) / 1024
    return float("nan")


class Trainer:
    """A process that trains when it is asked to, and is stopped otherwise."""

    def __init__(self, scene: Path, max_size: int, cache_mib: int, store: Path) -> None:
        command = [sys.executable, __file__, "--serve", str(scene), str(max_size), str(cache_mib)]
        environment = {**os.environ, "CROSSGRAD_CACHE": str(store)}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.first = self._read()
        self._process.send_signal(signal.SIGSTOP)

    def steps(self, count: int) -> dict[str, float]:
        """Let the process take `count` steps, and return their cost."""
        assert self._process.stdin is not None
        self._process.send_signal(signal.SIGCONT)
        self._process.stdin.write(f"{count}\n")
        self._process.stdin.flush()
        answer = self._read()
        self._process.send_signal(signal.SIGSTOP)
        return answer

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()

    def _read(self) -> dict[str, float]:
        assert self._process.stdout is not None
        answer: dict[str, float] = json.loads(self._process.stdout.readline())
        return answer


def measure(arguments: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    """Return a row for each pass over the photos."""
    few, many = folder / "few", folder / "many"
    for scene, photos in ((few, 28), (many, arguments.photos)):
        if not scene.exists():
            make_scene(scene, photos, distorted=arguments.distorted)
    store = folder / "store"
    if not arguments.warm:
        for entry in store.rglob("*.photo"):
            entry.unlink()
    held = Trainer(few, arguments.max_size, 4096, folder / "other store")
    loading = Trainer(many, arguments.max_size, arguments.cache_mib, store)
    rows, per_pass = [], int(loading.first["views"])
    try:
        for number in range(1, arguments.passes + 1):
            turns, left = [], per_pass
            while left > 0:
                count = min(arguments.block, left)
                turns.append((count, loading.steps(count), held.steps(count)))
                left -= count
            rows.append(row_of(number, turns))
            print(json.dumps(rows[-1]), flush=True)
    finally:
        held.end()
        loading.end()
    print(f"first step after {loading.first['seconds']:.1f} s ({held.first['seconds']:.1f} s)")
    return rows


def row_of(
    number: int, turns: list[tuple[int, dict[str, float], dict[str, float]]]
) -> dict[str, Any]:
    """Return sums and medians over the blocks of one pass."""
    steps = sum(count for count, _, _ in turns)
    ours, theirs = (sum(turn[who]["seconds"] for turn in turns) for who in (1, 2))
    third = max(1, len(turns) // 3)
    return {
        "pass": number,
        "steps": steps,
        "seconds per step": round(ours / steps, 4),
        "in memory": round(theirs / steps, 4),
        "ratio": round(ours / theirs, 3),
        "median of turns": round(median(a["seconds"] / b["seconds"] for _, a, b in turns), 3),
        "waited for photos": round(sum(a["waited"] for _, a, _ in turns) / ours, 3),
        "MiB first third": round(max(a["memory"] for _, a, _ in turns[:third])),
        "MiB last third": round(max(a["memory"] for _, a, _ in turns[-third:])),
        "peak MiB": round(turns[-1][1]["peak"]),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, default=2000)
    parser.add_argument("--max-size", type=int, default=1600, help="0: original size")
    parser.add_argument("--cache-mib", type=int, default=1280, help="data.cache_mib")
    parser.add_argument("--passes", type=int, default=2)
    parser.add_argument("--block", type=int, default=25, help="number of steps per turn")
    parser.add_argument("--distorted", action="store_true")
    parser.add_argument("--warm", action="store_true")
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="large-sets-") as temporary:
        rows = measure(arguments, arguments.folder or Path(temporary))
    print(json.dumps({**facts(), "code": code(), "options": vars(arguments)}, default=str))
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(str(value) for value in row.values()) + " |")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        serve(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
