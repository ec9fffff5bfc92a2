"""gsplat's own trainer, started from the folder of its examples, and its results."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stop:
    """Results of the trainer after a number of steps.

    Attributes:
        step: Number of steps.
        seconds: Wall time since the start of the training loop, including evaluations.
        psnr: PSNR of the held-out photos in dB, or None without an evaluation.
        gaussians: Number of Gaussians.
        mib: Peak memory of the GPU in MiB.
        file: File with these results.
    """

    step: int
    seconds: float
    psnr: float | None
    gaussians: int
    mib: float
    file: Path


def trained(
    examples: Path, scene: Path, runs: Path, stops: Sequence[int], limit: float | None
) -> tuple[list[Stop], str]:
    """Train to the last stop, unless results of the last stop exist.

    Return the stops that were reached, and the reason of a failure.

    Args:
        examples: The folder of gsplat's examples.
        scene: The COLMAP scene. Photos keep their size.
        runs: Folder for the result folder.
        stops: Steps at which the trainer evaluates and saves; training ends after the last one.
        limit: Seconds after which the trainer is stopped.
    """
    folder, why = runs / f"gsplat-trainer-{stops[-1]}", ""
    wanted = [str(stop) for stop in stops]
    if not _told(folder, stops[-1]).is_file():
        options = ["--data_dir", scene, "--data_factor", 1, "--result_dir", folder]
        options += ["--max_steps", stops[-1], "--eval_steps", *wanted, "--save_steps", *wanted]
        command = [sys.executable, "simple_trainer.py", "default", "--disable_viewer", *options]
        why = _failure(list(map(str, command)), examples, limit)
    reached = [_stop(folder, step) for step in stops if _told(folder, step).is_file()]
    if not why and len(reached) < len(stops):
        why = f"gsplat's trainer wrote no figures after {stops[-1]} steps"
    return reached, why


def _stop(folder: Path, step: int) -> Stop:
    told, held_out = _told(folder, step), folder / "stats" / f"val_step{step - 1:04d}.json"
    training = json.loads(told.read_text(encoding="utf-8"))
    shown = json.loads(held_out.read_text(encoding="utf-8")) if held_out.is_file() else {}
    return Stop(
        step,
        seconds=float(training["ellipse_time"]),
        psnr=shown.get("psnr"),
        gaussians=training["num_GS"],
        mib=1024 * float(training["mem"]),
        file=told,
    )


def _told(folder: Path, step: int) -> Path:
    return folder / "stats" / f"train_step{step - 1:04d}_rank0.json"


def _failure(command: list[str], folder: Path, limit: float | None) -> str:
    """Run a command in a folder. Return the reason if the command failed, else an empty text."""
    try:
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return f"stopped after {limit:g} s"
    return " ".join(ended.stderr.split())[-300:] if ended.returncode else ""
