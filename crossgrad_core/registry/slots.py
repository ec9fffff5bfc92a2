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
        "losses",
        "exposures",
        "initializers",
        "resolutions",
        "readers",
        "exporters",
        "metrics",
        "observers",
        "recipes",
        "rules",
    )
}
#: Slots that a run fills with a list of components.
LISTS: Final = ("metrics", "observers")
#: Slots that a run fills with any number of components; `rules` is a mapping of names.
MANY: Final = (*LISTS, "rules")
#: What packages offer as commands of `crossgrad`; no slot of a run.
COMMANDS: Final = "commands"
#: Everything that packages can offer -> entry-point group.
OFFERED: Final[dict[str, str]] = {**GROUPS, COMMANDS: f"crossgrad.{COMMANDS}"}
#: What decides settings of a run by its scene (`--plan`); no slot of a run either.
PLANNERS: Final = "planners"
#: Slot -> entry-point group of the functions that answer a question of `auto` before a component is
#: imported: `accepts` of a reader, `speed` of a rasterizer.
QUICK: Final = {
    "readers": "crossgrad.readers.accepts",
    "rasterizers": "crossgrad.rasterizers.speed",
}
#: The core's own commands, which no plugin replaces.
OWN_COMMANDS: Final = ("run", "eval", "render", "export")
