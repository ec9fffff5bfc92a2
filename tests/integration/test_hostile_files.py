"""Files that are made to fill the memory end in one error, in a process that has little of it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.hostile import HOSTILE

TESTS = Path(__file__).parents[1]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="bounds of memory are Linux's")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """How each file ended."""
    paths = [str(TESTS), str(TESTS / "fuzz"), os.environ.get("PYTHONPATH", "")]
    ended = subprocess.run(
        [sys.executable, "-m", "support.hostile", str(tmp_path_factory.mktemp("hostile"))],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_ends_in_one_error_within_the_memory_limit(name, found):
    assert found[name] in {"UserError", "ValueError"}


def test_a_hostile_file_exhausts_the_memory_without_the_limit(found):
    assert found["lists without a bound"] == "MemoryError"
