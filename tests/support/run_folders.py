"""Folders of runs as `crossgrad run` writes them, with figures that a test chooses."""

import csv
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from crossgrad_core.config import RunConfig
from crossgrad_core.run.results.config_file import write_config
from crossgrad_core.run.results.panels import Layout, flat_names, folder_of

DEFINITIONS = {
    "psnr": "dB; 20 log10(1 / sqrt(mse)) per image over all channels, mean over images",
    "ssim": "3DGS form: 11 x 11 window, sigma 1.5, zero padding, mean over images",
    "renders": "rounded to 8 bits per channel before comparison; masked pixels do not count",
}
ENVIRONMENT = {
    "crossgrad": "0.2.0",
    "cpu": "A Processor",
    "cpu_cores": 2,
    "torch_threads": 1,
    "device": "cpu",
    "gpu": None,
}
PHASES = {"decode": 0.1, "render": 0.25, "loss": 0.15, "backward": 0.35, "optimizer": 0.15}
PHOTOS = "photos: 400 x 300 px (16) from images/, not resized"


@dataclass(frozen=True)
class RunFolder:
    """What a run's folder says; `write` writes it.

    The PSNR rises as `final - 6 exp(-5 t)` with t from 0 to 1 over the run.
    """

    scene: str = "city"
    seed: int = 0
    final: float = 21.0
    settings: dict = field(default_factory=dict)
    steps: int = 600
    views_per_step: int = 1
    seconds: float = 60.0
    cpu_seconds: float | None = None
    planned: float | None = None
    evaluations: int = 12
    regimes: dict = field(default_factory=lambda: {"far": 1.5, "near": -1.5})
    held_out: tuple = ("a/1.jpg", "a/2.jpg", "b/1.jpg", "b/2.jpg")
    primitives: int = 100_000
    status: str = "finished"
    environment: dict = field(default_factory=dict)
    definitions: dict = field(default_factory=dict)
    photos: str = PHOTOS
    pictures: tuple = ()

    def write(self, folder: Path) -> Path:
        folder.mkdir(parents=True)
        config = RunConfig.model_validate(
            {
                "scene": f"/scenes/{self.scene}",
                "seed": self.seed,
                "steps": self.steps,
                "views_per_step": self.views_per_step,
                "planned_seconds": self.planned,
                **self.settings,
            }
        )
        write_config(folder, config)
        self._write_metrics(folder)
        self._write_views(folder)
        data = json.dumps(self._summary(config.model_dump(mode="json")), indent=2)
        (folder / "summary.json").write_text(data)
        self._write_scene(folder)
        self._write_pictures(folder)
        return folder

    def psnr(self, share: float) -> float:
        return self.final - 6.0 * math.exp(-5.0 * share) + 6.0 * math.exp(-5.0)

    def figures(self, share: float) -> dict:
        psnr = self.psnr(share)
        found = {"psnr": psnr, "ssim": psnr / 30.0}
        for regime, offset in self.regimes.items():
            found |= {f"psnr_{regime}": psnr + offset, f"ssim_{regime}": (psnr + offset) / 30.0}
        return found

    def _write_metrics(self, folder: Path) -> None:
        rows = []
        for number in range(1, self.evaluations + 1):
            share = number / self.evaluations
            step = round(share * self.steps)
            row = {"step": step, "views": step * self.views_per_step}
            row |= {"backward_passes": row["views"], "train_seconds": share * self.seconds}
            if self.cpu_seconds is not None:
                row["cpu_seconds"] = share * self.cpu_seconds
            row |= self.figures(share)
            row |= {"primitives": round(self.primitives * (0.5 + share / 2)), "loss": 0.1}
            rows.append({**row, "peak_memory_mib": 900.0})
        with (folder / "metrics.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    def view_figures(self) -> list[tuple[str, str, float]]:
        """Name, regime and PSNR of each held-out view; the first of a regime is the worst."""
        regimes = list(self.regimes)
        found = []
        for number, name in enumerate(self.held_out):
            regime = regimes[number * len(regimes) // len(self.held_out)]
            found.append((name, regime, self.final + self.regimes[regime] + (number % 2) - 0.5))
        return found

    def _write_views(self, folder: Path) -> None:
        lines = [["name", "regime", "psnr", "ssim"]]
        lines += [[name, regime, p, p / 30.0] for name, regime, p in self.view_figures()]
        with (folder / "per_view.csv").open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(lines)

    def _summary(self, config: dict) -> dict:
        final = self.figures(1.0)
        views = self.steps * self.views_per_step
        summary = {
            "status": self.status,
            "error": None,
            "scene": self.scene,
            "step": self.steps,
            "views": views,
            "backward_passes": views,
            "train_seconds": self.seconds,
            "primitives": self.primitives,
            "peak_memory_mib": 900.0,
            "overall": {"views": 4, "psnr": final["psnr"], "ssim": final["ssim"], "lpips": None},
            "regimes": {
                name: {"views": 2, "psnr": final[f"psnr_{name}"], "ssim": final[f"ssim_{name}"]}
                for name in self.regimes
            },
            "seconds": {
                "train": self.seconds,
                "compile": 4.0,
                "load": 2.0,
                "evaluate": 3.0,
                "report": 1.0,
                "phases": {name: share * self.seconds for name, share in PHASES.items()},
            },
            "seed": self.seed,
            "notes": [self.photos],
            "definitions": {**DEFINITIONS, **self.definitions},
            "environment": {**ENVIRONMENT, **self.environment},
            "config": config,
        }
        if self.cpu_seconds is not None:
            summary |= {"cpu_seconds": self.cpu_seconds, "peak_primitives": 2 * self.primitives}
        return summary

    def _write_scene(self, folder: Path) -> None:
        names = [*self.held_out, *(f"a/{number}.jpg" for number in range(10, 22))]
        photo = {"bytes": len(self.scene), "sha256": self.scene}
        views = {
            name: {"trained": name not in self.held_out, "photo": photo, "mask": None}
            for name in names
        }
        (folder / "scene.json").write_text(json.dumps({"format": 1, "views": views}))

    def _write_pictures(self, folder: Path) -> None:
        files = flat_names(self.held_out)
        for name in self.pictures:
            path = folder_of(folder, self.steps) / f"{files[name]}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            _panel(self.held_out.index(name), self.final).save(path)


def _panel(number: int, final: float) -> Image.Image:
    """A picture as large as those of a run, with a pattern of waves."""
    layout = Layout(400, 300)
    canvas = Image.new("RGB", layout.canvas, "white")
    y, x = np.mgrid[0:300, 0:400] / 40.0
    wave = np.stack([np.sin(x * (number + 1)), np.cos(y), np.sin(x + y)], axis=2)
    noise = np.random.default_rng(number).normal(size=wave.shape) * (25.0 - final) / 20.0
    images = (wave, wave + noise, np.abs(noise) - 1.0)
    for column, image in enumerate(images):
        pixels = np.clip(image * 100.0 + 128.0, 0, 255).astype(np.uint8)
        canvas.paste(Image.fromarray(pixels), (layout.left(column), layout.top))
    return canvas
