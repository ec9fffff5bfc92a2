"""How all figures look: sizes of print, colours for any colour vision, light and dark pages."""

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

#: Okabe and Ito's colours without their yellow, which is hard to see on white.
COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00")
MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X")
DASHES: Final = ("-", (0, (5, 1.6)), (0, (1, 1)), (0, (4, 1.2, 1, 1.2)))
INK, FAINT, GRID = "#1a1a1a", "#666666", "#e2e2e2"
#: Inches: a page of a paper with margins, and a column.
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
#: About how many letters a page is wide, how many the sign and the space of a label take, and by
#: what share the lines of a label are made shorter at a time.
_LETTERS, _BESIDE, _LETTERS_AT_ONCE = 110, 8, 10
#: Lines of a legend that every figure has room for, and inches that each takes.
_LEGEND_LINES, _LINE = 2, 0.18
#: A name may go on in the next line behind these signs, and anywhere in a part of this length.
_PARTS: Final = re.compile(r"[^\s_./-]{1,18}[\s_./-]*|[\s_./-]+")
_SVG: Final = re.compile(r"<svg\b.*", re.DOTALL)
_ID: Final = re.compile(r'(\bid="|url\(#|href="#)')


@dataclass(frozen=True)
class Drawn:
    """A figure in all its forms.

    Attributes:
        name: Its name, for files and ids.
        title: What it is called.
        caption: What it shows, for the page.
        svg: For the page: colours are variables of its style sheet.
        pdf: For a paper.
        png: For everything else.
        share: Its width as a share of a page's.
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
    """How an arm looks in every figure."""

    color: str
    marker: str
    dash: Any


def looks(arms: Sequence[str]) -> dict[str, Look]:
    """Arm -> how it looks; colour, marker and line differ at once, for print without colours."""
    return {
        arm: Look(
            COLORS[index % len(COLORS)],
            # Where colours come again marker and line are others.
            MARKERS[(index + index // len(COLORS)) % len(MARKERS)],
            DASHES[(index % len(COLORS) + index // len(COLORS)) % len(DASHES)],
        )
        for index, arm in enumerate(arms)
    }


@contextmanager
def styled() -> Iterator[None]:
    """Figures inside have this style; signs that a font lacks are no warning."""
    from matplotlib import rc_context

    with rc_context(_RC), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure of that size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def drawn(figure: "Figure", name: str, title: str, caption: str) -> Drawn:
    """The figure in all its forms; its layout is worked out once, not for each of them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
    figure.set_layout_engine("none")
    png, pdf, svg = io.BytesIO(), io.BytesIO(), io.StringIO()
    # Not by `savefig`, which works out the layout once more for every form.
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
    """The SVG element alone, with ids of its own and colours that the page chooses."""
    found = _SVG.search(svg)
    text = _ID.sub(rf"\1{name}-", found[0] if found else svg)
    for variable, color in variables().items():
        text = text.replace(color, f"var(--{variable})").replace(
            color.lower(), f"var(--{variable})"
        )
    return text


def variables() -> dict[str, str]:
    """Name of a variable of the page's style sheet -> the colour that stands for it in figures."""
    series = {f"series-{number}": color for number, color in enumerate(COLORS)}
    return {"ink": INK, "faint": FAINT, "grid": GRID, **series}


def literal(text: str) -> str:
    """Return text for a legend, which hides what begins with an underscore."""
    text = showable(text)
    return f"'{text}'" if text.startswith("_") else text


def panel_title(ax: "Axes", scene: str) -> None:
    """Writes a scene's name above its panel, on several lines where the panel is too narrow."""
    place = ax.get_subplotspec()
    beside = 1 if place is None else place.get_gridspec().ncols
    ax.set_title(wrapped(literal(one_line(scene)), _LETTERS // beside - _BESIDE), loc="left")


def legend(figure: "Figure", axes: "Axes", arms: Sequence[str], columns: int = 4) -> None:
    """Put the arms above all panels, as they are called in `axes`."""
    handles, labels = axes.get_legend_handles_labels()
    known = dict(zip(labels, handles, strict=True))
    shown = [literal(arm) for arm in arms if literal(arm) in known]
    legend_above(figure, [known[label] for label in shown], shown, columns)


def legend_above(
    figure: "Figure", handles: Sequence[Any], labels: Sequence[str], columns: int
) -> None:
    """Put a legend above all panels; no label leaves the figure, which grows by further lines.

    Args:
        figure: The figure.
        handles: A sign for each label.
        labels: The labels; longer ones than the figure is wide go on in further lines.
        columns: Columns at most.
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
        made.remove()  # Letters that are wider than usual.
        if columns > 1:
            columns -= 1
        else:
            letters -= 1 + letters // _LETTERS_AT_ONCE
    height = box.height / figure.dpi
    figure.set_figheight(figure.get_figheight() + max(0.0, height - _LEGEND_LINES * _LINE))


def wrapped(text: str, room: int) -> str:
    """The text on lines of at most so many letters, as far as its parts allow."""
    lines = [""]
    for part in _PARTS.findall(text):
        if lines[-1] and len(lines[-1] + part) > room:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
