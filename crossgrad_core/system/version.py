"""The version of crossgrad."""

from typing import Final

VERSION: Final = "0.2.0"
