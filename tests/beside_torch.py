"""Prints what the package and some of its extras need, but for torch and what builds on it.

    python tests/beside_torch.py test,lint > needs.txt

torch is half of all bytes: these packages are installed at the same time.
"""

import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"


def needs(extras: list[str], project: Path = PROJECT) -> list[str]:
    """The requirements of the package and these extras that do not need torch themselves."""
    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    optional = table["optional-dependencies"]
    every = [*table["dependencies"], *(each for extra in extras for each in optional[extra])]
    return [each for each in every if not each.startswith("torch")]


if __name__ == "__main__":
    sys.stdout.write("".join(f"{each}\n" for each in needs(sys.argv[1].split(","))))
