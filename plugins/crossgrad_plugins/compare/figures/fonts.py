"""The font of all figures: a small one, of European letters and signs alone.

A PDF embeds what it uses of a font, for which the whole font is read and searched, in every figure
anew: of the full one that took a sixth of the time of a comparison.
"""

from functools import cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crossgrad_core.commands import UserError, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What the small font is called, and the full one, with which signs are drawn that it lacks.
SMALL: Final = "crossgrad DejaVu Sans"
FULL: Final = "DejaVu Sans"
#: Latin letters; dashes and quotation marks; arrows and signs of mathematics.
_SIGNS: Final = (range(0x20, 0x250), range(0x2000, 0x2070), range(0x2190, 0x2300))
#: Changes with what is left out of the font: files of other forms stay unused.
_FORM: Final = 1
#: The records of a font's name that tell its family.
_FAMILY: Final = (1, 4, 16)


@cache
def family() -> str:
    """The family that figures are drawn in: the small one, or where it cannot be kept the full one.

    It is kept where matplotlib keeps its list of fonts, from which later processes read it:
    matplotlib opens the file as often as it draws, and forked ones would leave files of their own.
    """
    import matplotlib
    from matplotlib.font_manager import fontManager

    try:
        for weight in ("normal", "bold"):
            name = f"crossgrad-{matplotlib.__version__}-{_FORM}-{weight}.ttf"
            path = Path(matplotlib.get_cachedir()) / name
            if not path.is_file():
                write_atomically(path, _small(weight))
            fontManager.addfont(path)
    except (UserError, OSError, RuntimeError):  # The last one: a file that is no font.
        return FULL
    return SMALL


def fall_back(figure: "Figure") -> None:
    """Lets the figure's texts with other signs find them in the full font.

    Only these: a text with two families looks both up, each time that it is measured.
    """
    from matplotlib.text import Text

    known = {chr(sign) for signs in _SIGNS for sign in signs} | {"\n"}
    for text in figure.findobj(Text):
        if isinstance(text, Text) and not known.issuperset(text.get_text()):
            text.set_fontfamily([SMALL, FULL])


def _small(weight: str) -> bytes:
    from fontTools import subset
    from matplotlib.font_manager import FontProperties, findfont

    options: Any = subset.Options(layout_features=[], legacy_kern=True, hinting=True)
    # Matplotlib's own drops this table by name, too: it would be warned of.
    options.drop_tables += ["FFTM"]
    full = findfont(FontProperties(family=FULL, weight=weight), fallback_to_default=False)
    subsetter = subset.Subsetter(options)
    subsetter.populate(unicodes=[sign for signs in _SIGNS for sign in signs])
    with subset.load_font(full, options) as font:
        subsetter.subset(font)
        for record in font["name"].names:
            if record.nameID in _FAMILY:
                record.string = SMALL
        file = BytesIO()
        font.save(file)
    return file.getvalue()
