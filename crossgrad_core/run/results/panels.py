"""renders/<step>/<view>.png: photo, render and error side by side, with a legend."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import View
from crossgrad_core.evaluation.evaluation import Evaluated
from crossgrad_core.evaluation.result import ViewMetrics
from crossgrad_core.run.results.panel_layout import Layout, enlargement, folder_of
from crossgrad_core.run.results.panel_names import chosen_views, flat_names
from crossgrad_core.system.files import disk_errors, write_atomically

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont

#: Errors of this size and above have the last colour; fixed, so that panels compare.
LARGEST_ERROR = 0.25
_COLORMAP = "inferno"
_TICKS = (0.0, 0.05, 0.10, 0.15, 0.20, 0.25)
_PAPER, _INK, _FAINT = (255, 255, 255), (20, 20, 20), (105, 105, 105)
_HATCH = ((188, 188, 188), (150, 150, 150))

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class PanelWriter:
    """Writes panels of some held-out views during an evaluation; pass `write` as `on_view`.

    Attributes:
        folder: renders/<step> of the run.
        files: View name -> file name without suffix, of the views that get a panel.
        step: The step, for the title.
    """

    folder: Path
    files: dict[str, str]
    step: int

    @classmethod
    def of(cls, run: Path, step: int, views: Sequence[View], count: int) -> "PanelWriter":
        """For at most `count` of these views, spread over the regimes."""
        names = flat_names([view.name for view in views])
        chosen = {view.name: names[view.name] for view in chosen_views(views, count)}
        return cls(folder_of(run, step), chosen, step)

    def write(self, evaluated: Evaluated) -> None:
        """Writes the panel of a view, if it gets one.

        Raises:
            UserError: The disk is full.
        """
        file = self.files.get(evaluated.compared.view.name)
        if file is None:
            return
        with disk_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        picture = io.BytesIO()
        draw_panel(evaluated, self.step).save(picture, format="png")
        write_atomically(self.folder / f"{file}.png", picture.getvalue())


def draw_panel(evaluated: Evaluated, step: int) -> "Image":
    """Photo | render | error with labels, a colour legend and masked pixels hatched."""
    from PIL import Image, ImageDraw

    photo, render = (
        _enlarged(evaluated.compared.photo.numpy()),
        _enlarged(evaluated.compared.render.numpy()),
    )
    mask = (
        None
        if evaluated.compared.mask is None
        else _enlarged(evaluated.compared.mask.byte().numpy())
    )
    layout = Layout(photo.shape[1], photo.shape[0])
    canvas = Image.new("RGB", layout.canvas, _PAPER)
    pictures = (photo, render, _hatched(error_map(photo, render), mask, layout.font))
    for column, picture in enumerate(pictures):
        canvas.paste(Image.fromarray(picture), (layout.left(column), layout.top))
    draw = ImageDraw.Draw(canvas)
    _label(draw, layout, evaluated.metrics, step)
    _color_bar(canvas, draw, layout)
    if mask is not None and not mask.all():
        _mask_key(canvas, draw, layout)
    return canvas


def error_map(photo: Pixels, render: Pixels) -> Pixels:
    """[H, W, 3] colours of the absolute error, mean over the channels of [H, W, 3] images."""
    error = np.abs(photo.astype(np.int16) - render.astype(np.int16)).mean(axis=2) / 255.0
    return _colored(error / LARGEST_ERROR)


def _colored(values: NDArray[np.float64]) -> Pixels:
    """Colours [..., 3] of values, clipped to [0, 1]."""
    from matplotlib import colormaps

    table = (colormaps[_COLORMAP](np.arange(256))[:, :3] * 255.0).round().astype(np.uint8)
    index = (np.clip(values, 0.0, 1.0) * 255.0).round().astype(np.intp)
    colors: Pixels = table[index]
    return colors


def _enlarged(image: Pixels) -> Pixels:
    factor = enlargement(image.shape[1])
    enlarged: Pixels = image.repeat(factor, axis=0).repeat(factor, axis=1)
    return enlarged


def _hatched(image: Pixels, mask: Pixels | None, period: int) -> Pixels:
    """The image with diagonal grey stripes where the mask is False."""
    if mask is None:
        return image
    y, x = np.indices(mask.shape)
    stripes = np.array(_HATCH, dtype=np.uint8)[((x + y) // max(2, period // 4)) % 2]
    return np.where(mask[:, :, None], image, stripes)


def _font(size: int, *, bold: bool = False) -> "FreeTypeFont":
    """Matplotlib's own DejaVu Sans: on every machine, with signs for names in most scripts."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    file = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(get_data_path(), "fonts", "ttf", file)), size)


def _label(draw: "ImageDraw", layout: Layout, metrics: ViewMetrics, step: int) -> None:
    bold, font = _font(layout.font, bold=True), _font(layout.font)
    line = layout.margin + layout.font  # base line of the title
    draw.text((layout.margin, line), metrics.name, fill=_INK, font=bold, anchor="ls")
    after = layout.margin + draw.textlength(metrics.name, font=bold) + layout.font
    text = f"{metrics.regime}, step {step:,}"
    draw.text((after, line), text, fill=_FAINT, font=font, anchor="ls")
    figures = [
        f"{name} {value:{form}}"
        for name, value, form in (
            ("PSNR", metrics.values.get("psnr"), ".2f"),
            ("SSIM", metrics.values.get("ssim"), ".3f"),
        )
        if value is not None
    ]
    render = f"render: {', '.join(figures)}" if figures else "render"
    for column, caption in enumerate(("photo", render, "error: mean |photo - render| of RGB")):
        place = (layout.left(column), layout.captions)
        draw.text(place, caption, fill=_INK, font=font, anchor="ls")


def _color_bar(canvas: "Image", draw: "ImageDraw", layout: Layout) -> None:
    """The colours of the error map right of it, as shares of the full scale."""
    from PIL import Image

    font = _font(round(0.85 * layout.font))
    left, right = layout.left(3), layout.left(3) + layout.bar
    ramp = _colored(np.linspace(1.0, 0.0, layout.height))[:, None].repeat(layout.bar, axis=1)
    canvas.paste(Image.fromarray(ramp), (left, layout.top))
    for tick in _TICKS:
        y = layout.top + round((1.0 - tick / LARGEST_ERROR) * (layout.height - 1))
        draw.line((right, y, right + layout.font // 3, y), fill=_FAINT)
        text = f"\u2265 {tick:.2f}" if tick == LARGEST_ERROR else f"{tick:.2f}"
        place = (right + layout.font // 2, y)
        draw.text(place, text, fill=_FAINT, font=font, anchor="lm")


def _mask_key(canvas: "Image", draw: "ImageDraw", layout: Layout) -> None:
    """What the hatching means, right-aligned above the error map."""
    from PIL import Image

    size, font = layout.font, _font(layout.font)
    right = layout.left(2) + layout.width
    draw.text((right, layout.captions), "masked", fill=_FAINT, font=font, anchor="rs")
    blank = np.zeros((size, size), dtype=np.uint8)
    swatch = Image.fromarray(_hatched(blank[:, :, None].repeat(3, axis=2), blank, size))
    left = right - round(draw.textlength("masked", font=font)) - round(1.5 * size)
    canvas.paste(swatch, (left, layout.captions - round(0.85 * size)))
