"""Make scenes with few training photos from a scene with many.

    python benchmarks/few_photos.py OUT --photos 8 14 --draw 1 SCENES/ochota_kap_hybrid_gain ...
    crossgrad sweep benchmarks/grids/few_photos.yaml --threads 1 --scene OUT/... --scene SCENE

The program makes folders such as OUT/SCENE-8. Each folder contains links to photos and cameras, a
random list of training photos, and the scene's list of held-out photos. The program prints the
median number of training photos in which a point is visible.
"""

import argparse
from pathlib import Path

import numpy as np

from crossgrad_core.commands import configured, photos_per_point, read_scene


def made(scene: Path, out: Path, photos: int, draw: int) -> float:
    """Make the scene, and return the median number of training photos that show a point."""
    config = configured({"scene": str(scene), "data": {"max_size": 64}})
    whole, _ = read_scene(config)
    names = [view.name for view in whole.train_views]
    chosen = np.random.default_rng(draw).choice(names, size=photos, replace=False)
    out.mkdir(parents=True)
    for part in ("images", "sparse"):
        (out / part).symlink_to((scene / part).resolve())
    held_out = [view.name for view in whole.test_views]
    for file, listed in (("train_list.txt", sorted(chosen)), ("test_list.txt", held_out)):
        (out / file).write_text("".join(f"{name}\n" for name in listed))
    few, _ = read_scene(configured({"scene": str(out), "data": {"max_size": 64}}))
    return photos_per_point(few)


def main() -> None:
    """Make the requested scenes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--photos", type=int, nargs="+", default=[8])
    parser.add_argument("--draw", type=int, default=1, help="number of the random draw of photos")
    given = parser.parse_args()
    for scene in given.scenes:
        for photos in given.photos:
            folder = given.out / f"{scene.name}-{photos}"
            print(folder, f"{made(scene, folder, photos, given.draw):g} photos show a point")


if __name__ == "__main__":
    main()
