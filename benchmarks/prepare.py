"""Measure time, registered photos and accuracy of `crossgrad prepare`, in a table.

    python benchmarks/prepare.py PHOTOS SCENE [--truth MODEL ...] [-- OPTION ...]

Each `--truth` is a folder with a COLMAP model of the same photos, which are matched by name.
Several true models must have one coordinate frame. The prepared cameras are aligned to the true
cameras by a similarity, with RANSAC followed by least squares over the agreeing cameras. The
remaining error is divided by the diagonal of the box around all true cameras. Options after `--`
are passed to `crossgrad prepare`. If the scene is already finished, the program only evaluates it
and shows no times.
"""

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
import pycolmap
from _machine import code, facts
from numpy.typing import NDArray

#: The pose of a camera counts as found if its error is at most this share of the scene's size.
CLOSE = 0.005
#: A camera agrees with a similarity if its error is at most this share of the scene's size.
AGREES = 0.01

Poses = Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]


def poses_of(folders: Sequence[Path]) -> Poses:
    """Return rotation [3, 3] (world to camera) and centre [3] for each name, of all models."""
    found = {}
    for folder in folders:
        for image in pycolmap.Reconstruction(folder).images.values():
            rotation = image.cam_from_world().rotation.matrix()
            found[image.name] = (np.asarray(rotation), np.asarray(image.projection_center()))
    return found


def errors_of(found: Poses, truth: Poses) -> tuple[dict[str, tuple[float, float]], float]:
    """Return for each name a position error and an angle, and the size of the scene.

    The position error is a share of this size; the angle is in degrees.
    """
    names = sorted(found.keys() & truth.keys())
    here = np.array([found[name][1] for name in names])
    there = np.array([truth[name][1] for name in names])
    every = np.array([center for _, center in truth.values()])
    size = float(np.linalg.norm(np.ptp(every, axis=0)))
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = AGREES * size, 0
    robust = pycolmap.estimate_sim3d_robust(here, there, options)
    if robust is None:
        return dict.fromkeys(names, (float("inf"), 180.0)), size
    agrees = np.asarray(robust["inlier_mask"], dtype=bool)
    similarity = pycolmap.estimate_sim3d(here[agrees], there[agrees])
    matrix, turn = similarity.matrix(), similarity.rotation.matrix()
    distances = np.linalg.norm(here @ matrix[:, :3].T + matrix[:, 3] - there, axis=1) / size
    angles = [_angle(found[name][0] @ turn.T @ truth[name][0].T) for name in names]
    return dict(zip(names, zip(distances.tolist(), angles, strict=True), strict=True)), size


def _angle(rotation: NDArray[np.float64]) -> float:
    """Return the angle of a rotation in degrees."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))


def prepare(photos: Path, scene: Path, options: Sequence[str]) -> tuple[float, float, float]:
    """Run the command, and return wall seconds, CPU seconds and peak memory in GiB."""
    command = [sys.executable, "-m", "crossgrad_core", "prepare", str(photos), str(scene), *options]
    begun = perf_counter()
    subprocess.run(command, check=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return perf_counter() - begun, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20


def rows(scene: Path, truth: Poses) -> list[str]:
    """Return a line for each folder and a line for all: photos, registered photos and errors."""
    report = json.loads((scene / "report.json").read_text())
    errors, size = errors_of(poses_of([scene / "sparse" / "0"]), truth) if truth else ({}, 0.0)
    lines = []
    for row in [*report["folders"], {"folder": "all", "photos": report["used"],
                                     "registered": report["registered"]}]:  # fmt: skip
        name = row["folder"]
        own = [errors[each] for each in errors if name in {"all", each.rpartition("/")[0]}]
        cells = [name or "(no folder)", str(row["photos"]), str(row["registered"])]
        if own:
            distances, angles = np.array(own).T
            cells += [f"{100 * np.median(distances):.3f} %", f"{100 * distances.max():.3f} %",
                      f"{np.median(angles):.3f}", f"{(distances <= CLOSE).sum()}"]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    if truth:
        lines.append(f"\nsize of the scene: {size:.1f} units of the true model")
    return lines


def main() -> None:
    """Prepare a scene if it is not finished, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--truth", type=Path, action="append", default=[])
    # Split the words here, because argparse cannot read options after a list of positional
    # arguments.
    words = [*sys.argv[1:], "--"]
    ours = words.index("--")
    given = parser.parse_args(words[:ours])
    if not (given.scene / "report.json").is_file():
        wall, cpu, memory = prepare(given.photos, given.scene, words[ours + 1 : -1])
        print(f"{wall:.0f} s, {cpu:.0f} s of CPU time, at most {memory:.1f} GiB")
    report = json.loads((given.scene / "report.json").read_text())
    print(f"{report['matching']} matching, {report['mapper']} mapping, mean reprojection error "
          f"{report['model']['reprojection_error_px']:.3f} pixels")  # fmt: skip
    if report["gps"] is not None:
        residuals = {key: report["gps"][key] for key in ("rms_horizontal", "rms_vertical", "max")}
        print("GPS residuals in m:", residuals)
    print("| folder | photos | registered | error, median | largest | degrees | within 0.5 % |")
    print("|---|---|---|---|---|---|---|")
    print("\n".join(rows(given.scene, poses_of(given.truth))))
    machine = facts()
    print(f"\n{code()}, {machine['cpu']}, {machine['cores']} cores, load {machine['load']}, "
          f"{machine['date']}, pycolmap {pycolmap.__version__}")  # fmt: skip


if __name__ == "__main__":
    main()
