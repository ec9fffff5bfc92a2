"""gsplat's own trainer, from the folder of its examples, and what it says of itself."""

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stop:
    """Figures of the trainer after some steps.

    Attributes:
        step: How many.
        seconds: Of the clock since its loop began; evaluations on the way are in them.
        psnr: Of the held-out photos, dB; None where it has not evaluated.
        gaussians: Their number.
        mib: Most memory of the GPU, MiB.
        file: Where it says so.
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
    """Trains where the last stop has not been reached; the stops reached, and what went wrong.

    Args:
        examples: The folder of gsplat's examples.
        scene: The scene, COLMAP; photos as they are.
        runs: Where its folder goes.
        stops: Steps at which it evaluates and says what it has; it ends at the last one.
        limit: Seconds after which it is stopped.
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
        why = f"it wrote no figures after {stops[-1]} steps"
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
    """Runs a command in a folder; why it did not come to its end, else nothing."""
    try:
        ended = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return f"stopped after {limit:g} s"
    return " ".join(ended.stderr.split())[-300:] if ended.returncode else ""
