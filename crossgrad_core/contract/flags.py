"""How a setting appears on the command line; stands beside its type and bounds in the schema."""

from dataclasses import dataclass
from typing import Final

#: Headings of the help, in its order.
CONFIGURATION: Final = "Configuration"
PARTS: Final = "Components (`crossgrad plugins list` shows the names)"
TRAINING: Final = "Training"
SCENE: Final = "Scene"
MACHINE: Final = "Machine"
RESULTS: Final = "Results"
HEADINGS: Final = (CONFIGURATION, PARTS, TRAINING, SCENE, MACHINE, RESULTS)


@dataclass(frozen=True)
class Flag:
    """The option of a setting; its type and its help are those of the field.

    Attributes:
        metavar: What the help shows for its value.
        heading: Heading under which the help lists it, one of `HEADINGS`; empty for an argument.
        name: Its name without dashes, where it is not the setting's.
        common: Whether `--help` shows it; `--help-all` shows every option.
    """

    metavar: str
    heading: str = ""
    name: str = ""
    common: bool = False
