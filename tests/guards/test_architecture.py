"""docs/architecture.md names what there is: rooms, shelves, files, and the picture of them."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
CORE = ROOT / "crossgrad_core"
SHELVES = ("backbones", "operators", "plugins")


def rooms():
    """The files and folders with code at the top of the core."""
    folders = {path.parent.name for path in CORE.glob("*/__init__.py")}
    return folders | {path.stem for path in CORE.glob("*.py")}


def test_every_room_is_named_and_every_named_room_exists():
    rows = re.findall(r"^\| \d+ \| (.+?) \|", PAGE, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(named) == sorted(rooms())


def test_every_shelf_is_named():
    rows = re.findall(r"^\| `(\w+)/` \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert tuple(shelf for shelf, _ in rows) == SHELVES
    assert all((ROOT / shelf / package).is_dir() for shelf, package in rows)
    for shelf, package in rows:
        line = next(line for line in PAGE.splitlines() if line.startswith(f"| `{shelf}/`"))
        inside = re.findall(r"`(\w+)/`", line)[1:]
        assert all((ROOT / shelf / package / folder).is_dir() for folder in inside)


FILES = sorted(set(re.findall(r"`((?:\w+/)+\w+\.\w+)`", PAGE)))


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_is_named_exists(name):
    assert (ROOT / name).is_file()


def test_both_paths_name_files_of_the_core_and_of_a_shelf():
    for title in ("The path of a photo", "The path of `--operator pcgrad`"):
        path = PAGE.partition(f"## {title}")[2].partition("\n## ")[0]
        named = re.findall(r"^\| `(\w+)/", path, re.MULTILINE)
        assert len(named) > 6
        assert "crossgrad_core" in named and set(named) & set(SHELVES)


def test_the_picture_shows_the_rooms():
    picture = (ROOT / "docs" / "layers.svg").read_text(encoding="utf-8")
    shown = re.findall(r"<text[^>]*>(\w+)</text>", picture)
    assert sorted(shown) == sorted(rooms() | set(SHELVES))
