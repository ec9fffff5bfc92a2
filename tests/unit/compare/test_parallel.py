"""Figures that are drawn by several processes."""

import subprocess
import sys

import pytest

from crossgrad_core.commands import available_cores

PROGRAM = """
import os
from functools import partial
from crossgrad_plugins.compare.parallel import in_parallel

def drawn(number):
    if number == {fails}:
        raise ValueError("cannot be drawn")
    return number, os.getpid()

found = in_parallel([partial(drawn, number) for number in range(5)])
assert [number for number, _ in found] == list(range(5))
print(len({{process for _, process in found}} - {{os.getpid()}}))
"""


def answer(fails):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(fails=fails)],
        check=False,
        capture_output=True,
        text=True,
    )


@pytest.mark.skipif(
    sys.platform != "linux" or len(available_cores()) < 2, reason="needs two cores of Linux"
)
def test_other_processes_draw_in_order():
    found = answer(fails=None)
    assert found.returncode == 0, found.stderr
    assert int(found.stdout) > 0


def test_what_cannot_be_drawn_is_raised():
    found = answer(fails=3)
    assert found.returncode == 1
    assert "ValueError: cannot be drawn" in found.stderr
