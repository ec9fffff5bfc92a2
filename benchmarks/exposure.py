"""PSNR of the held-out views of runs, as they are and with the exposure of each photo taken out.

    python benchmarks/exposure.py RUN [RUN ...]

Photos of one place often differ in exposure and white balance. Here every render is fitted to its
photo by least squares, a gain and an offset per channel, before it is measured again: what is left
is the error of structure and detail.
"""

import argparse
from pathlib import Path
from statistics import mean

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.run.export import renderer
from crossgrad_core.run.opening import opened


def psnr(image: NDArray[np.float64], photo: NDArray[np.float64]) -> float:
    """PSNR in dB of two [H, W, 3] images in [0, 1]."""
    return float(-10.0 * np.log10(np.mean((image - photo) ** 2)))


def fitted(image: NDArray[np.float64], photo: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image with the gain and the offset of each channel that bring it closest to the photo."""
    channels = []
    for own, wanted in zip(image.reshape(-1, 3).T, photo.reshape(-1, 3).T, strict=True):
        rows = np.stack([own, np.ones_like(own)], axis=1)
        channels.append(rows @ np.linalg.lstsq(rows, wanted, rcond=None)[0])
    return np.stack(channels, axis=1).reshape(image.shape).clip(0.0, 1.0)


def main() -> None:
    """Prints a line for each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    print("| run | PSNR | exposure taken out |\n|---|---|---|")
    for run in parser.parse_args().runs:
        setup, state = opened(run, {}, -1)
        draw = renderer(setup, state)
        found = []
        for view in setup.scene.test_views:
            image = draw(view).detach().cpu().double().clamp(0.0, 1.0).numpy()
            photo = view.photo.image().numpy() / 255.0
            found.append((psnr(image, photo), psnr(fitted(image, photo), photo)))
        plain, corrected = (mean(each) for each in zip(*found, strict=True))
        print(f"| {run.name} | {plain:.2f} | {corrected:.2f} |", flush=True)


if __name__ == "__main__":
    main()
