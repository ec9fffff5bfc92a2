"""The slots that plugins fill, and their entry-point groups. Imports nothing heavy."""

from typing import Final

#: Slot name -> entry-point group.
GROUPS: Final[dict[str, str]] = {
    slot: f"crossgrad.{slot}"
    for slot in (
        "backbones",
        "samplers",
        "groupings",
        "operators",
        "densifiers",
        "rasterizers",
        "readers",
        "observers",
    )
}
