"""Numbers in the text of an element of Metashape's XML."""

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.readers._json import Fields


def numbers(element: Element | None, count: int, file: Path, place: str) -> NDArray[np.float64]:
    """[count] numbers in the text of an element.

    Raises:
        UserError: The element is missing, or holds something else.
    """
    words = (element.text or "").split() if element is not None else []
    values: list[object] = []
    for word in words[: count + 1]:
        try:
            values.append(word if "_" in word else float(word))
        except ValueError:
            values.append(word)
    return Fields({"text": values}, file, place).numbers("text", count)
