"""The font of all figures: a small one, of European letters and signs alone.

A PDF embeds what it uses of a font, for which the whole font is read and searched, in every figure
anew: of the full one that took a sixth of the time of a comparison.
"""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: What the small font is called, and the full one, with which signs are drawn that it lacks.
SMALL: Final = "crossgrad DejaVu Sans"
FULL: Final = "DejaVu Sans"
#: Latin letters; dashes and quotation marks; arrows and signs of mathematics.
_SIGNS: Final = (range(0x20, 0x250), range(0x2000, 0x2070), range(0x2190, 0x2300))
#: The records of a font's name that tell its family.
_FAMILY: Final = (1, 4, 16)


def family() -> str:
    """The family that figures are drawn in; its font is made at the first call."""
    _folder()
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


@cache
def _folder() -> TemporaryDirectory[str]:
    """Where the small font is until the process ends; matplotlib opens it as often as it draws."""
    from matplotlib.font_manager import fontManager

    folder = TemporaryDirectory(prefix="crossgrad-fonts-")
    for weight in ("normal", "bold"):
        path = Path(folder.name) / f"{weight}.ttf"
        _write_small(weight, path)
        fontManager.addfont(path)
    return folder


def _write_small(weight: str, path: Path) -> None:
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
        font.save(path)
