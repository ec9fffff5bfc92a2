"""Compose the picture of the README: two panels of a run on the left, its curve on the right.

python benchmarks/figure.py RUN docs/images/boruszyn.png
"""

import argparse
from pathlib import Path

from PIL import Image

WIDTH = 1400


def main() -> None:
    """Compose the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    last = max((arguments.run / "renders").iterdir())
    panels = [Image.open(path).convert("RGB") for path in sorted(last.glob("*.png"))]
    panels = [panels[0], panels[-1]]
    height = sum(panel.height for panel in panels)
    curve = Image.open(arguments.run / "curve.png").convert("RGB")
    curve = curve.resize(
        (round(curve.width * height / curve.height), height), Image.Resampling.LANCZOS
    )
    canvas = Image.new("RGB", (panels[0].width + curve.width, height), "white")
    top = 0
    for panel in panels:
        canvas.paste(panel, (0, top))
        top += panel.height
    canvas.paste(curve, (panels[0].width, 0))
    size = (WIDTH, round(canvas.height * WIDTH / canvas.width))
    canvas.resize(size, Image.Resampling.LANCZOS).quantize(256).save(arguments.out, optimize=True)


if __name__ == "__main__":
    main()
