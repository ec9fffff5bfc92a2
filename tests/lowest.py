"""Prints the lowest versions that pyproject.toml admits, as constraints for pip.

    python tests/lowest.py > lowest.txt
    pip install --constraint lowest.txt "crossgrad[test]"

What these packages need themselves is left to pip.
"""

import re
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
EXTRAS = ("torchjd", "test")
BOUND = re.compile(r"^(?P<name>[\w.-]+)(?:\[[\w,-]+\])?>=(?P<version>[\d.]+)")


def requirements(wanted: Sequence[str], project: Path = PROJECT) -> list[str]:
    """What the package and some of its extras need, as pyproject.toml says it."""
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    extras = table["optional-dependencies"]
    return [*table["dependencies"], *(each for extra in wanted for each in extras[extra])]


def lowest(requirement: str) -> str:
    """The lowest version of a requirement as a pin; raises ValueError where it has no bound."""
    found = BOUND.match(requirement)
    if found is None:
        raise ValueError(f"{requirement!r} names no lowest version: write NAME>=VERSION")
    return f"{found['name']}=={found['version']}"


if __name__ == "__main__":
    pins = dict.fromkeys(map(lowest, requirements(EXTRAS)))
    sys.stdout.write("".join(f"{pin}\n" for pin in pins))
