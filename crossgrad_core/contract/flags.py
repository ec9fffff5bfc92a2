"""The appearance of a setting on the command line.

The setting's pydantic field contains the type and the bounds.
"""

from dataclasses import dataclass
from typing import Final

#: Headings of the help text, in their order.
CONFIGURATION: Final = "Configuration"
PARTS: Final = "Components (`crossgrad plugins list` shows the names)"
TRAINING: Final = "Training"
SCENE: Final = "Scene"
MACHINE: Final = "Machine"
RESULTS: Final = "Results"
HEADINGS: Final = (CONFIGURATION, PARTS, TRAINING, SCENE, MACHINE, RESULTS)


@dataclass(frozen=True)
class Flag:
    """The command-line option of a setting; its type and help text come from the setting's field.

    Attributes:
        metavar: The placeholder for the option's value in the help text.
        heading: Heading under which the help text lists the option, one of `HEADINGS`; empty for
            an argument.
        name: Name of the option without dashes, if it differs from the name of the setting.
        common: True if `--help` shows the option; `--help-all` shows every option.
    """

    metavar: str
    heading: str = ""
    name: str = ""
    common: bool = False
