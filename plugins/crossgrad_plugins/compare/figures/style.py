"""The style of all figures: font sizes, colour-blind safe colours, light and dark pages."""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from crossgrad_core.commands import one_line, showable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: The palette of Okabe and Ito without yellow, which is hard to see on white.
COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00")
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X")
DASHES: Final = ("-", (0, (5, 1.6)), (0, (1, 1)), (0, (4, 1.2, 1, 1.2)))
INK, FAINT, GRID = "#1a1a1a", "#666666", "#e2e2e2"
#: Widths in inches: the text width of a page, and the width of a column.
PAGE, COLUMN = 7.0, 3.4
_RC: Final[Any] = {
    "axes.edgecolor": FAINT,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8.5,
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 3.5,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "svg.hashsalt": "crossgrad",
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": FAINT,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.color": FAINT,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 7.5,
}
_DPI: Final = 220
#: Number of characters per page width, and number of characters that the marker and gap of a legend
#: label need. The third number determines how much shorter lines are tried: the line length divided
#: by this number.
_LETTERS, _BESIDE, _LETTERS_AT_ONCE = 110, 8, 10
#: Number of legend lines that every figure has space for, and height of a line in inches.
_LEGEND_LINES, _LINE = 2, 0.18
#: A name may be broken after one of these characters. A longer part without these characters may be
#: broken at any position.
_PARTS: Final = re.compile(r"[^\s_./-]{1,18}[\s_./-]*|[\s_./-]+")
_SVG: Final = re.compile(r"<svg\b.*", re.DOTALL)
_ID: Final = re.compile(r'(\bid="|url\(#|href="#)')


@dataclass(frozen=True)
class Drawn:
    """A figure in all its file formats.

    Attributes:
        name: Name of the figure, for files and ids.
        title: Title of the figure.
        caption: Description of the figure, for the page.
        svg: SVG for the page; its colours are variables of the page's style sheet.
        pdf: PDF for a paper.
        png: PNG for other uses.
        share: Width of the figure, as a share of the page width.
    """

    name: str
    title: str
    caption: str
    svg: str
    pdf: bytes
    png: bytes
    share: float = 1.0


@dataclass(frozen=True)
class Look:
    """The colour, marker and line style that an arm has in every figure."""

    color: str
    marker: str
    dash: Any


def looks(arms: Sequence[str]) -> dict[str, Look]:
    """Return the look of each arm.

    Arms differ in colour, marker and line style, so that they can be distinguished in print without
    colours.
    """
    return {
        arm: Look(
            COLORS[index % len(COLORS)],
            # After the last colour, the colours start again with another marker and line style.
            MARKERS[(index + index // len(COLORS)) % len(MARKERS)],
            DASHES[(index % len(COLORS) + index // len(COLORS)) % len(DASHES)],
        )
        for index, arm in enumerate(arms)
    }


@contextmanager
def styled() -> Iterator[None]:
    """Apply the style to figures inside the `with` block; ignore warnings about missing glyphs."""
    from matplotlib import rc_context

    with rc_context(_RC), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of the given size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def drawn(figure: "Figure", name: str, title: str, caption: str) -> Drawn:
    """Return the figure in all its formats; its layout is computed only once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine("none")
    png, pdf, svg = io.BytesIO(), io.BytesIO(), io.StringIO()
    # `savefig` alone would compute the layout again for every format.
    for_png: Any = FigureCanvasAgg(figure)
    for_png.print_png(png)
    for_pdf: Any = FigureCanvasPdf(figure)
    for_pdf.print_pdf(pdf, metadata={"CreationDate": None})
    figure.patch.set_visible(False)
    for ax in figure.axes:
        ax.patch.set_visible(False)
    for_svg: Any = FigureCanvasSVG(figure)
    for_svg.print_svg(svg, metadata={"Date": None})
    return Drawn(
        name,
        title,
        caption,
        _for_page(svg.getvalue(), name),
        pdf.getvalue(),
        png.getvalue(),
        figure.get_figwidth() / PAGE,
    )


def _for_page(svg: str, name: str) -> str:
    """Return the SVG element with unique ids and with colours that the page's style sheet sets."""
    match = _SVG.search(svg)
    text = _ID.sub(rf"\1{name}-", match[0] if match else svg)
    for variable, color in variables().items():
        text = text.replace(color, f"var(--{variable})").replace(
            color.lower(), f"var(--{variable})"
        )
    return text


def variables() -> dict[str, str]:
    """Return for each style sheet variable of the page its colour in figures."""
    series = {f"series-{number}": color for number, color in enumerate(COLORS)}
    return {"ink": INK, "faint": FAINT, "grid": GRID, **series}


def literal(text: str) -> str:
    """Return a text for a legend.

    A leading underscore would hide the entry, so it is quoted.
    """
    text = showable(text)
    return f"'{text}'" if text.startswith("_") else text


def panel_title(ax: "Axes", scene: str) -> None:
    """Write a scene's name above its panel, in several lines if needed."""
    subplot = ax.get_subplotspec()
    beside = 1 if subplot is None else subplot.get_gridspec().ncols
    ax.set_title(wrapped(literal(one_line(scene)), _LETTERS // beside - _BESIDE), loc="left")


def legend(figure: "Figure", axes: "Axes", arms: Sequence[str], columns: int = 4) -> None:
    """Put the legend of the arms, with the handles of `axes`, above all panels."""
    handles, labels = axes.get_legend_handles_labels()
    by_label = dict(zip(labels, handles, strict=True))
    shown = [literal(arm) for arm in arms if literal(arm) in by_label]
    legend_above(figure, [by_label[label] for label in shown], shown, columns)


def legend_above(
    figure: "Figure", handles: Sequence[Any], labels: Sequence[str], columns: int
) -> None:
    """Put a legend above all panels; the figure grows if the legend has many lines.

    Args:
        figure: The figure.
        handles: A handle for each label.
        labels: The labels; a label that is wider than the figure gets several lines.
        columns: Maximum number of columns.
    """
    letters = int(_LETTERS * figure.get_figwidth() / PAGE)
    longest = max((len(label) for label in labels), default=1)
    columns = max(1, min(columns, len(labels), letters // (longest + _BESIDE)))
    while True:
        made = figure.legend(
            handles,
            [wrapped(label, max(1, letters - _BESIDE)) for label in labels],
            loc="outside upper left",
            ncols=columns,
            handlelength=2.6,
            columnspacing=1.4,
            borderaxespad=0.0,
        )
        box = made.get_window_extent()
        if box.width <= figure.bbox.width or letters <= _BESIDE:
            break
        made.remove()  # If the characters are wider than estimated, try shorter lines.
        if columns > 1:
            columns -= 1
        else:
            letters -= 1 + letters // _LETTERS_AT_ONCE
    height = box.height / figure.dpi
    figure.set_figheight(figure.get_figheight() + max(0.0, height - _LEGEND_LINES * _LINE))


def wrapped(text: str, room: int) -> str:
    """Break a text into lines of at most `room` letters, if possible."""
    lines = [""]
    for part in _PARTS.findall(text):
        if lines[-1] and len(lines[-1] + part) > room:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
