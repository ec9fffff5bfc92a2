"""Format lists of names, and sizes of photos, for notes and error messages."""

from collections.abc import Sequence

from crossgrad_core.wording import count, showable

__all__ = ["count", "megapixels", "name_some"]

_SHOWN = 3


def name_some(names: Sequence[str]) -> str:
    """Return the first names of a list, followed by the number of the remaining names."""
    shown = showable(", ".join(names[:_SHOWN]).replace("\n", r"\n"))
    return shown + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def megapixels(pixels: int) -> str:
    """Format a number of pixels like `201.3 megapixels`."""
    return f"{pixels / 1e6:,.1f} megapixels"
