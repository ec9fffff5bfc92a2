"""Where panels lie, and where in a panel photo, render and error are. Imports no torch."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.panel_names import flat_names
from crossgrad_core.system.checksums import check_unchanged

if TYPE_CHECKING:
    from PIL.Image import Image

FOLDER = "renders"

#: Smaller images are enlarged by a whole factor, so that the labels fit.
_NARROWEST = 360
_SMALLEST_FONT, _LARGEST_FONT, _FONTS_PER_WIDTH = 12, 26, 38
_COLUMNS = ("photo", "render", "error")
_TODO = "draw the panels again: crossgrad render RUN, or remove the file"


@dataclass(frozen=True)
class Layout:
    """Sizes in pixels, all derived from the size of the (enlarged) image."""

    width: int
    height: int

    @property
    def font(self) -> int:
        """Size of the letters."""
        return min(max(self.width // _FONTS_PER_WIDTH, _SMALLEST_FONT), _LARGEST_FONT)

    @property
    def margin(self) -> int:
        """Around everything."""
        return self.font

    @property
    def gap(self) -> int:
        """Between two images."""
        return max(4, self.font // 2)

    @property
    def top(self) -> int:
        """Upper edge of the images."""
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
        """Left edge of the photo (0), render (1), error (2) and colour bar (3)."""
        return self.margin + column * (self.width + self.gap)

    @classmethod
    def in_canvas(cls, size: tuple[int, int]) -> "Layout | None":
        """The layout of a panel of this width and height; None where no panel has that size."""
        for width in range(size[0] // 3, 0, -1):
            outside = cls(width, 0)
            if outside.canvas[0] == size[0]:
                height = size[1] - outside.canvas[1]
                return cls(width, height) if height > 0 else None
        return None


def enlargement(width: int) -> int:
    """The factor by which an image of this width is enlarged."""
    return -(-_NARROWEST // width)


def folder_of(run: Path, step: int) -> Path:
    """Where the panels of an evaluation lie."""
    return run / FOLDER / f"{step:06d}"


def panels_of(run: Path, step: int, names: Sequence[str]) -> dict[str, Path]:
    """View name -> picture of its photo, render and error, of those held-out views that have one.

    Args:
        run: The run's folder.
        step: The step of the evaluation.
        names: Names of all held-out views, in the order of per_view.csv.
    """
    folder = folder_of(run, step)
    paths = {name: folder / f"{file}.png" for name, file in flat_names(names).items()}
    return {name: path for name, path in paths.items() if path.is_file()}


def read_panel(path: Path) -> "dict[str, Image]":
    """The images in such a picture by name: `photo`, `render` and `error`.

    Raises:
        UserError: It is no such picture.
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
        raise _unreadable(path, f"a picture of {panel.width} x {panel.height} px")
    lower = layout.top + layout.height
    left = [layout.left(column) for column in range(len(_COLUMNS))]
    boxes = [(x, layout.top, x + layout.width, lower) for x in left]
    return {name: panel.crop(box) for name, box in zip(_COLUMNS, boxes, strict=True)}


def _unreadable(path: Path, found: str) -> UserError:
    return UserError(
        "unreadable panel",
        where=path,
        found=found,
        todo=_TODO,
    )
