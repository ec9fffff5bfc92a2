"""Measure differences in exposure between the photos of a scene, for docs/exposure.md.

    python benchmarks/exposure.py SCENE [SCENE ...]

All photos of a scene are used at full size, including held-out photos. Seconds are CPU seconds of
the process; reading the scene and decoding photos do not count.
"""

import argparse
from pathlib import Path
from time import process_time

from crossgrad_core.commands import configured, read_scene
from crossgrad_plugins.exposures.exif import exposure_value
from crossgrad_plugins.exposures.tracks.gains import TrackGains, track_gains

HEADER = (
    "| scene | photos | EXIF | std of gains, stops | standard error | range | deviation, stops "
    "| auto | seconds |\n|---|---|---|---|---|---|---|---|---|"
)


def row(name: str, with_exif: int, gains: TrackGains, seconds: float) -> str:
    """Return the table line of a scene.

    `with_exif` is the number of photos that have an exposure in EXIF.
    """
    known = gains.gains[gains.known]
    ends = f"{known.min():+.2f} .. {known.max():+.2f}" if len(known) else "-"
    auto = "gain" if gains.differ else "none"
    deviation = f"{gains.fit.before:.2f} -> {gains.fit.after:.2f}"
    return (
        f"| {name} | {len(known)} of {len(gains.gains)} | {with_exif} | {gains.spread:.2f} "
        f"| {gains.error:.3f} | {ends} | {deviation} | {auto} | {seconds:.1f} |"
    )


def main() -> None:
    """Print a line for each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    print(HEADER)
    for path in parser.parse_args().scenes:
        scene, _ = read_scene(configured({"scene": path, "threads": 1}))
        with_exif = sum(exposure_value(view) is not None for view in scene.views)
        for view in scene.views:
            view.photo.image()
        start = process_time()
        gains = track_gains(scene, scene.views)
        print(row(scene.name, with_exif, gains, process_time() - start), flush=True)


if __name__ == "__main__":
    main()
