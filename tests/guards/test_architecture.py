"""docs/architecture.md names the packages, the plugin packages and the files that there are."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
CORE = ROOT / "crossgrad_core"
PLUGIN_PACKAGES = ("backbones", "operators", "plugins")


def packages():
    """The files and folders with code at the top of the core."""
    folders = {path.parent.name for path in CORE.glob("*/__init__.py")}
    return folders | {path.stem for path in CORE.glob("*.py")}


def test_the_architecture_page_names_exactly_the_existing_packages():
    rows = re.findall(r"^\| \d+ \| (.+?) \|", PAGE, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(packages())


def test_the_architecture_page_names_every_plugin_package():
    rows = re.findall(r"^\| `(\w+)/` \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert tuple(folder for folder, _ in rows) == PLUGIN_PACKAGES
    assert all((ROOT / folder / package).is_dir() for folder, package in rows)
    for top, package in rows:
        line = next(line for line in PAGE.splitlines() if line.startswith(f"| `{top}/`"))
        inside = re.findall(r"`(\w+)/`", line)[1:]
        assert all((ROOT / top / package / folder).is_dir() for folder in inside)


FILES = sorted(set(re.findall(r"`((?:\w+/)+\w+\.\w+)`", PAGE)))


@pytest.mark.parametrize("name", FILES)
def test_every_file_named_on_the_architecture_page_exists(name):
    assert (ROOT / name).is_file()


def test_both_documented_code_paths_name_files_of_the_core_and_of_a_plugin_package():
    for title in ("The path of a photo", "The path of `--operator pcgrad`"):
        path = PAGE.partition(f"## {title}")[2].partition("\n## ")[0]
        named = re.findall(r"^\| `(\w+)/", path, re.MULTILINE)
        assert len(named) > 6
        assert "crossgrad_core" in named and set(named) & set(PLUGIN_PACKAGES)


def test_the_diagram_shows_the_packages():
    picture = (ROOT / "docs" / "layers.svg").read_text(encoding="utf-8")
    shown = re.findall(r"<text[^>]*>(\w+)</text>", picture)
    assert sorted(shown) == sorted(packages() | set(PLUGIN_PACKAGES))
