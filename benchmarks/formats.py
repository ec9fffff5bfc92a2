"""Write every format of exports: bytes, seconds, and the loss against the PLY.

    python benchmarks/formats.py RUN RUN [--gaussians 1000000] [--page docs/results/formats.md]

The table of each run gives bytes per Gaussian, and the PSNR between images of the Gaussians of a
file and images of the PLY's Gaussians, over the held-out views of the run. The times are for one
file of `--gaussians` Gaussians, which are copies of the first run's Gaussians with noise.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time

import numpy as np
import torch
from _machine import code, facts, peak_mib

from crossgrad_core.commands import build
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.slots.exporter import ExportContent, Exporter
from crossgrad_core.evaluation.evaluation import psnr
from crossgrad_core.run.export import plain_drawer
from crossgrad_core.run.postprocess.open_options import How
from crossgrad_core.training.setup import Setup

#: Exporters and their options.
FORMATS = (
    ("ply", {}),
    ("spz", {"version": 2}),
    ("spz", {"version": 3}),
    ("glb", {}),
    ("tiles", {}),
    ("usd", {}),
    ("sog", {}),
    ("html", {}),
    ("splat", {}),
)


@dataclass(frozen=True)
class Written:
    """A file: its bytes, and the seconds of its writing by the clock and of the processor."""

    size: int
    wall: float
    cpu: float


def written(exporter: Exporter, content: ExportContent) -> Written:
    """Write a file to a temporary folder."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{exporter.suffix or 'folder'}"
        wall, cpu = perf_counter(), process_time()
        exporter.write(content, path)
        wall, cpu = perf_counter() - wall, process_time() - cpu
        files = [path] if path.is_file() else [*path.iterdir()]
        return Written(sum(file.stat().st_size for file in files), wall, cpu)


def many(gaussians: Gaussians, number: int) -> Gaussians:
    """Return `number` noisy copies, whose numbers compress as badly as those of a large scene."""
    rng = torch.Generator().manual_seed(0)
    rows = torch.arange(number) % len(gaussians)
    copies = gaussians.mapped(lambda tensor: tensor[rows])
    sizes = copies.scales.max(dim=1, keepdim=True).values
    moved = copies.means + 0.2 * sizes * torch.randn(copies.means.shape, generator=rng)
    rest = copies.sh_rest
    if rest is not None:
        rest = rest + 0.01 * torch.randn(rest.shape, generator=rng)
    return replace(copies, means=moved, sh_rest=rest)


def of_run(path: Path) -> tuple[Setup, Gaussians]:
    """Return a run, and the Gaussians of its PLY in the local frame."""
    setup, _ = How("cpu", None, accept_scene=True).open(path)
    ply = build(Exporter, "ply", {})
    return setup, ply.read(path / "point_cloud.ply", setup.scene.similarity)


def rows(setup: Setup, gaussians: Gaussians) -> Iterator[str]:
    """Yield the lines of the table of a run."""
    similarity, views = setup.scene.similarity, setup.scene.test_views
    content = ExportContent(gaussians, similarity, up=setup.scene.up)
    draw = plain_drawer(setup, gaussians)
    for name, options in FORMATS:
        exporter = build(Exporter, name, options)
        drawn = plain_drawer(setup, exporter.stored(gaussians, similarity))
        with torch.no_grad():
            values = [psnr(drawn(v).clamp(0, 1), draw(v).clamp(0, 1), None) for v in views]
        # Files without a loss differ by the rounding of logarithms, above 80 dB.
        mean = float(np.mean([value for value in values if value is not None]))
        loss = f"{mean:.1f} dB" if exporter.lossy else "equal"
        size = written(exporter, content).size
        yield f"| {label(name, options)} | {size / len(gaussians):.1f} | {loss} |"


def label(name: str, options: dict[str, int]) -> str:
    """Return the name of a format with its version."""
    return f"`{name}`" + (f" version {options['version']}" if options else "")


def main() -> None:
    """Measure, and print the page or write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    names = " ".join(run.name for run in given.runs)
    lines = [
        "# Formats of exports",
        "",
        "Size and time of each format, and its loss against the PLY. [Exports](../exports.md) "
        "describes the formats.",
        "",
        f"    python benchmarks/formats.py {names} --gaussians {given.gaussians}",
        "",
    ]
    first = None
    for run in given.runs:
        setup, gaussians = of_run(run)
        first = gaussians if first is None else first
        lines += [
            f"**`{run.name}`**: {len(gaussians):,} Gaussians, {len(setup.scene.test_views)} "
            "held-out views. PSNR compares images of the file with images of the PLY.",
            "",
            "| format | bytes per Gaussian | PSNR to the PLY |",
            "|---|---|---|",
            *rows(setup, gaussians),
            "",
        ]
    assert first is not None
    content = ExportContent(many(first, given.gaussians), setup.scene.similarity)
    lines += [
        f"**Time** to write {given.gaussians:,} Gaussians with all spherical harmonics:",
        "",
        "| format | seconds | CPU seconds | bytes per Gaussian |",
        "|---|---|---|---|",
    ]
    for name, options in FORMATS:
        result = written(build(Exporter, name, options), content)
        lines.append(
            f"| {label(name, options)} | {result.wall:.1f} | {result.cpu:.1f} | "
            f"{result.size / given.gaussians:.1f} |"
        )
    machine = facts()
    lines += [
        "",
        f"The process used at most {peak_mib():,.0f} MiB. Commit {code()}, {machine['cpu']}, "
        f"{machine['cores']} cores, load {machine['load']}, {str(machine['date'])[:10]}.",
    ]
    text = "\n".join(lines) + "\n"
    print(text)
    if given.page is not None:
        given.page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
