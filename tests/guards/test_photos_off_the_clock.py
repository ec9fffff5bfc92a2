"""Plugins of a step ask their context for photos, so that decoding counts as loading."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
#: What decodes on whatever clock is running.
DECODES = re.compile(r"\.photo\.(image|mask)\(")
#: Code that decodes outside training: trackers during an evaluation, and the viewer for its frames,
#: whose seconds have a limit of their own.
ALLOWED = {"tracker.py", "frames.py"}
PLUGIN_PACKAGES = ("backbones", "operators", "plugins")


@pytest.mark.parametrize("folder", PLUGIN_PACKAGES)
def test_no_plugin_decodes_photos_itself(folder):
    sources = sorted((ROOT / folder).rglob("*.py"))
    assert sources
    found = {path.name for path in sources if DECODES.search(path.read_text(encoding="utf-8"))}
    assert found <= ALLOWED


def test_the_pattern_finds_code_that_decodes_photos():
    source = ROOT / "crossgrad_core" / "training" / "views.py"
    assert DECODES.search(source.read_text(encoding="utf-8"))
