"""renders/<step>/<view>.png: photo, render and error side by side, with a legend."""

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import View
from crossgrad_core.errors import UserError
from crossgrad_core.evaluation.evaluation import Evaluated
from crossgrad_core.evaluation.result import ViewMetrics
from crossgrad_core.system.checksums import check_unchanged
from crossgrad_core.system.files import disk_errors, write_atomically

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont


_UNSAFE = re.compile(r"[^\w.+-]+")
_LONGEST = 120  # bytes


def flat_names(names: Sequence[str]) -> dict[str, str]:
    """Return view name -> unique file name without folders and suffix.

    Two file names always differ in more than upper and lower case.

    `aerial/0001.jpg` becomes `aerial__0001`; a name that is already used gets -2, -3 and so on.
    """
    flat: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        path = PurePosixPath(name)
        parts = [part for part in path.with_suffix("").parts if part not in {"..", "/"}]
        base = ending(_UNSAFE.sub("_", "__".join(parts)).strip(".")) or "view"
        unique, number = base, 1
        while unique.casefold() in taken:
            number += 1
            unique = f"{base}-{number}"
        taken.add(unique.casefold())
        flat[name] = unique
    return flat


def ending(name: str) -> str:
    """Return at most the last `_LONGEST` bytes of a name, so that a file name can contain it."""
    return name.encode()[-_LONGEST:].decode(errors="ignore")


def chosen_views(views: "Sequence[View]", count: int) -> "tuple[View, ...]":
    """Return at most `count` views, taken evenly from all regimes and evenly within a regime."""
    regimes = sorted({view.regime for view in views})
    groups = [[view for view in views if view.regime == regime] for regime in regimes]
    share = [0] * len(groups)
    for _ in range(min(count, len(views))):
        # Among the regimes with the fewest chosen views, the first regime gets one more view.
        unused = [i for i, group in enumerate(groups) if share[i] < len(group)]
        share[min(unused, key=share.__getitem__)] += 1
    chosen = {
        view.name
        for group, wanted in zip(groups, share, strict=True)
        for view in _spread(group, wanted)
    }
    return tuple(view for view in views if view.name in chosen)


def _spread(group: "Sequence[View]", wanted: int) -> "list[View]":
    wanted = min(wanted, len(group))
    return [group[(2 * i + 1) * len(group) // (2 * wanted)] for i in range(wanted)]


FOLDER = "renders"
#: Minimum width of an image in a panel, in pixels. Smaller images are enlarged by an integer
#: factor, so that the labels fit.
_NARROWEST = 360
_SMALLEST_FONT, _LARGEST_FONT, _FONTS_PER_WIDTH = 12, 26, 38
_COLUMNS = ("photo", "render", "error")
_TODO = "render the panels again: crossgrad render RUN, or remove the file"


@dataclass(frozen=True)
class Layout:
    """Sizes of a panel in pixels, all derived from the size of the (enlarged) image."""

    width: int
    height: int

    @property
    def font(self) -> int:
        """Size of the letters."""
        return min(max(self.width // _FONTS_PER_WIDTH, _SMALLEST_FONT), _LARGEST_FONT)

    @property
    def margin(self) -> int:
        """Space around the whole panel."""
        return self.font

    @property
    def gap(self) -> int:
        """Space between two images."""
        return max(4, self.font // 2)

    @property
    def top(self) -> int:
        """Vertical position of the upper edge of the images."""
        return self.margin + round(3.2 * self.font)

    @property
    def captions(self) -> int:
        """Base line of the captions above the images."""
        return self.top - self.font // 2

    @property
    def bar(self) -> int:
        """Width of the colour bar."""
        return max(10, self.font)

    @property
    def canvas(self) -> tuple[int, int]:
        """Width and height of the panel."""
        legend = self.gap + self.bar + 5 * self.font
        width = 2 * self.margin + 3 * self.width + 2 * self.gap + legend
        return width, self.top + self.height + self.margin

    def left(self, column: int) -> int:
        """Return the left edge of the photo (0), render (1), error (2) and colour bar (3)."""
        return self.margin + column * (self.width + self.gap)

    @classmethod
    def in_canvas(cls, size: tuple[int, int]) -> "Layout | None":
        """Return the layout of a panel of this width and height; None if no panel has that size."""
        for width in range(size[0] // 3, 0, -1):
            outside = cls(width, 0)
            if outside.canvas[0] == size[0]:
                height = size[1] - outside.canvas[1]
                return cls(width, height) if height > 0 else None
        return None


def enlargement(width: int) -> int:
    """Return the factor by which an image of this width is enlarged."""
    return -(-_NARROWEST // width)


def folder_of(run: Path, step: int) -> Path:
    """Return the folder of the panels of an evaluation."""
    return run / FOLDER / f"{step:06d}"


def panels_of(run: Path, step: int, names: Sequence[str]) -> dict[str, Path]:
    """Return view name -> panel with photo, render and error, for views with a panel.

    Args:
        run: The run's folder.
        step: The step of the evaluation.
        names: Names of all held-out views, in the order of per_view.csv.
    """
    folder = folder_of(run, step)
    paths = {name: folder / f"{file}.png" for name, file in flat_names(names).items()}
    return {name: path for name, path in paths.items() if path.is_file()}


def read_panel(path: Path) -> "dict[str, Image]":
    """Return the images in a panel by name: `photo`, `render` and `error`.

    Raises:
        UserError: The file is not a panel.
    """
    from PIL import Image

    run = path.parents[2]
    check_unchanged(run, [path.relative_to(run).as_posix()], _TODO)
    try:
        with Image.open(path, formats=["PNG"]) as file:
            panel = file.convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise _unreadable(path, str(error)) from error
    layout = Layout.in_canvas(panel.size)
    if layout is None:
        raise _unreadable(path, f"an image of {panel.width} x {panel.height} px")
    lower = layout.top + layout.height
    left = [layout.left(column) for column in range(len(_COLUMNS))]
    boxes = [(x, layout.top, x + layout.width, lower) for x in left]
    return {name: panel.crop(box) for name, box in zip(_COLUMNS, boxes, strict=True)}


def _unreadable(path: Path, found: str) -> UserError:
    return UserError(
        "a panel image cannot be read",
        where=path,
        found=found,
        todo=_TODO,
    )


#: Smallest error that gets the last colour of the colour map. This limit is fixed, so that panels
#: of different runs are comparable.
LARGEST_ERROR = 0.25
_COLORMAP = "inferno"
_TICKS = (0.0, 0.05, 0.10, 0.15, 0.20, 0.25)
_PAPER, _INK, _FAINT = (255, 255, 255), (20, 20, 20), (105, 105, 105)
_HATCH = ((188, 188, 188), (150, 150, 150))
Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class PanelWriter:
    """A writer of panels for some views; an evaluation calls `write` for each view.

    Attributes:
        folder: renders/<step> of the run.
        files: View name -> file name without suffix, for the views that get a panel.
        step: The step, for the title.
    """

    folder: Path
    files: dict[str, str]
    step: int

    @classmethod
    def of(cls, run: Path, step: int, views: Sequence[View], count: int) -> "PanelWriter":
        """Return a writer for at most `count` of these views, taken evenly from all regimes."""
        names = flat_names([view.name for view in views])
        chosen = {view.name: names[view.name] for view in chosen_views(views, count)}
        return cls(folder_of(run, step), chosen, step)

    def write(self, evaluated: Evaluated) -> None:
        """Write the panel of a view, if the view is chosen.

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
    """Draw photo | render | error with labels and a colour legend; masked pixels are hatched."""
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
    """Return [H, W, 3] colours of the mean absolute error over the channels of [H, W, 3] images."""
    error = np.abs(photo.astype(np.int16) - render.astype(np.int16)).mean(axis=2) / 255.0
    return _colored(error / LARGEST_ERROR)


def _colored(values: NDArray[np.float64]) -> Pixels:
    """Return the colours [..., 3] of values, clipped to [0, 1]."""
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
    """Return the image with diagonal grey stripes where the mask is False."""
    if mask is None:
        return image
    y, x = np.indices(mask.shape)
    stripes = np.array(_HATCH, dtype=np.uint8)[((x + y) // max(2, period // 4)) % 2]
    return np.where(mask[:, :, None], image, stripes)


def _font(size: int, *, bold: bool = False) -> "FreeTypeFont":
    """Return the font DejaVu Sans, which Matplotlib contains and which covers most scripts."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    file = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(get_data_path(), "fonts", "ttf", file)), size)


def _label(draw: "ImageDraw", layout: Layout, metrics: ViewMetrics, step: int) -> None:
    bold, font = _font(layout.font, bold=True), _font(layout.font)
    line = layout.margin + layout.font  # baseline of the title
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
        position = (layout.left(column), layout.captions)
        draw.text(position, caption, fill=_INK, font=font, anchor="ls")


def _color_bar(canvas: "Image", draw: "ImageDraw", layout: Layout) -> None:
    """Draw the colours of the error map to the right of the map, with error values."""
    from PIL import Image

    font = _font(round(0.85 * layout.font))
    left, right = layout.left(3), layout.left(3) + layout.bar
    ramp = _colored(np.linspace(1.0, 0.0, layout.height))[:, None].repeat(layout.bar, axis=1)
    canvas.paste(Image.fromarray(ramp), (left, layout.top))
    for tick in _TICKS:
        y = layout.top + round((1.0 - tick / LARGEST_ERROR) * (layout.height - 1))
        draw.line((right, y, right + layout.font // 3, y), fill=_FAINT)
        text = f"\u2265 {tick:.2f}" if tick == LARGEST_ERROR else f"{tick:.2f}"
        position = (right + layout.font // 2, y)
        draw.text(position, text, fill=_FAINT, font=font, anchor="lm")


def _mask_key(canvas: "Image", draw: "ImageDraw", layout: Layout) -> None:
    """Draw the key of the hatching, right-aligned above the error map."""
    from PIL import Image

    size, font = layout.font, _font(layout.font)
    right = layout.left(2) + layout.width
    draw.text((right, layout.captions), "masked", fill=_FAINT, font=font, anchor="rs")
    blank = np.zeros((size, size), dtype=np.uint8)
    swatch = Image.fromarray(_hatched(blank[:, :, None].repeat(3, axis=2), blank, size))
    left = right - round(draw.textlength("masked", font=font)) - round(1.5 * size)
    canvas.paste(swatch, (left, layout.captions - round(0.85 * size)))
