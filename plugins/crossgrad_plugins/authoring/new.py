"""`crossgrad plugins new`: a small package with one plugin as a starting point."""

import re
import tomllib
from functools import cache
from importlib.util import find_spec
from keyword import iskeyword
from pathlib import Path
from typing import Final

from crossgrad_core.commands import (
    COMMANDS,
    OFFERED,
    VERSION,
    UserError,
    disk_errors,
    entries,
    listed,
    singular,
    with_article,
)

#: Possible folders of the example package: in an installed wheel, and in a checkout.
_EXAMPLES: Final = (
    Path(__file__).with_name("example"),
    Path(__file__).parents[3] / "examples" / "plugin",
)
_NAME: Final = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
_PROJECT: Final = """\
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "{name}"
version = "0.1.0"
description = "{a_word} for crossgrad"
requires-python = ">=3.11"
dependencies = ["crossgrad>={version},<{next}"]

[project.optional-dependencies]
test = ["pytest"]

[project.entry-points."{group}"]
{name} = "{module}:{member}"

[tool.hatch.build.targets.wheel]
only-include = ["{module}.py"]
"""
_TEST: Final = '''\
"""The contract checks of {some_word}."""

import pytest
from {module} import {member}

from crossgrad_core.testing.{slot} import {checks}


@pytest.mark.parametrize("check", {checks}, ids=lambda check: check.__name__)
def test_contract(check):
    check({member})
'''


@cache
def examples() -> dict[str, tuple[Path, str]]:
    """Return for each slot the module and the class or function of its example plugin."""
    folder = next(folder for folder in _EXAMPLES if folder.is_dir())
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    slots = {group: slot for slot, group in OFFERED.items()}
    sources = {}
    for group, plugins in project["entry-points"].items():
        (value,) = plugins.values()
        module, _, member = value.partition(":")
        sources[slots[group]] = folder.joinpath(*module.split(".")).with_suffix(".py"), member
    return sources


def write_package(name: str, slot: str, folder: Path) -> tuple[Path, ...]:
    """Write pyproject.toml, one module from the example package, and one test.

    Args:
        name: Name of the plugin and of the package.
        slot: The slot, one of `OFFERED`.
        folder: Output folder, which this function creates.

    Returns:
        The paths of the written files.

    Raises:
        UserError: The name is invalid or already used, or the folder is not empty.
    """
    module = name.replace("-", "_")
    _check(name, module, slot)
    _check_empty(folder)
    files = {folder / path: text for path, text in _contents(name, module, slot).items()}
    with disk_errors(folder):
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return tuple(files)


def _contents(name: str, module: str, slot: str) -> dict[str, str]:
    """Return the text of each file; keys are paths relative to the output folder."""
    kind = "".join(word.capitalize() for word in name.split("-"))
    member = module if slot == COMMANDS else kind
    example, model = examples()[slot]
    source = example.read_text(encoding="utf-8")
    major, minor = VERSION.split(".")[:2]
    words = {
        "name": name,
        "module": module,
        "member": member,
        "slot": slot,
        "a_word": with_article(singular(slot)).capitalize(),
        "some_word": with_article(singular(slot)),
        "group": OFFERED[slot],
        "checks": f"{singular(slot).upper()}_CHECKS",
        "version": f"{major}.{minor}",
        "next": f"{major}.{int(minor) + 1}",
    }
    return {
        "pyproject.toml": _PROJECT.format(**words),
        # A rule's random generator has the rule's entry-point name.
        f"{module}.py": re.sub(rf"\b{model}\b", member, source).replace(
            f'rngs["{example.stem}"]', f'rngs["{name}"]'
        ),
        f"tests/test_{module}.py": _TEST.format(**words),
    }


def _check(name: str, module: str, slot: str) -> None:
    if not _NAME.fullmatch(name) or iskeyword(module):
        raise UserError(
            f"{name!r} is not a valid name of a plugin",
            where="NAME",
            expected="lower-case words joined by hyphens, such as equal-length",
            todo="choose another name",
        )
    taken = entries(slot).get(name)
    if taken is not None or find_spec(module) is not None:
        holder = taken.origin if taken else f"an installed package {module}"
        raise UserError(
            f"an installed plugin already uses the name {name}",
            where="NAME",
            found=holder,
            todo="choose another name",
        )


def _check_empty(folder: Path) -> None:
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UserError(
            "the output folder already contains files",
            where=folder,
            found=listed(sorted(path.name for path in folder.iterdir())[:5])
            if folder.is_dir()
            else "a file",
            todo="choose another name, or another folder with --out",
        )
