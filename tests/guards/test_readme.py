"""The plugin shown in README.md is installed from there without changes, and used."""

import re
import sys
import tomllib
from pathlib import Path
from textwrap import dedent

import pytest
from support.distributions import write_distribution
from support.scenes import write_tiny_scene

import crossgrad_core as cg
from crossgrad_core.registry.entries import load
from crossgrad_core.registry.slots import GROUPS
from crossgrad_core.testing.checking import checks_of

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHOWN = README.partition("## A plugin in 20 lines")[2].partition("\n## ")[0]


def shown(file):
    """What the section shows as the content of a file."""
    lines = [line for line in SHOWN.splitlines() if line.startswith("    ") or not line]
    code = dedent("\n".join(lines))
    return re.split(
        r"^# [\w.]+$", code.partition(f"# {file}\n")[2], maxsplit=1, flags=re.MULTILINE
    )[0]


@pytest.fixture
def installed(tmp_path, monkeypatch):
    points = tomllib.loads(shown("pyproject.toml"))["project"]["entry-points"]
    slots = {group: slot for slot, group in GROUPS.items()}
    plugins = {slots[group]: names for group, names in points.items()}
    write_distribution(
        tmp_path / "site", "my-plugin", plugins, {"my_plugin": shown("my_plugin.py")}
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    yield plugins
    sys.modules.pop("my_plugin", None)


def test_the_plugin_in_the_readme_has_20_lines():
    assert len([line for line in SHOWN.splitlines() if line.startswith("    ")]) <= 20


def test_the_operator_in_the_readme_keeps_the_contract(installed):
    kind = load("operators", "louder")
    for check in checks_of("operators"):
        check(kind)
        check(lambda: kind(sharpness=2.0))


def test_the_command_in_the_readme_trains_with_the_operator(installed, tmp_path):
    command = re.search(r"`crossgrad run (--operator louder .*?)`", SHOWN)[1].split()
    name, (key, value) = command[1], command[3].split("=")
    scene = write_tiny_scene(tmp_path / "tiny", views=9)
    run = cg.run(scene, operator=name, **{key: float(value)}, steps=3, out=tmp_path / "run",
                 quiet=True)  # fmt: skip
    assert run.summary["config"]["operator"]["sharpness"] == 2.0
