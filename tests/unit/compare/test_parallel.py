"""Figures that are drawn by several processes."""

import signal
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


#: Drawings that take longer than any test; each worker tells that it has begun.
LONG = """
import os, time
from functools import partial
from crossgrad_plugins.compare.parallel import in_parallel

def drawn(number):
    os.write(1, b"x")
    time.sleep(600)

in_parallel([partial(drawn, number) for number in range(2)])
"""
several_cores = pytest.mark.skipif(
    sys.platform != "linux" or len(available_cores()) < 2, reason="needs two cores of Linux"
)


def answer(fails):
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(fails=fails)],
        check=False,
        capture_output=True,
        text=True,
    )


@several_cores
def test_other_processes_draw_in_order():
    found = answer(fails=None)
    assert found.returncode == 0, found.stderr
    assert int(found.stdout) > 0


def test_what_cannot_be_drawn_is_raised():
    found = answer(fails=3)
    assert found.returncode == 1
    assert "ValueError: cannot be drawn" in found.stderr


@several_cores
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_the_process_that_they_draw_for(number):
    with subprocess.Popen([sys.executable, "-c", LONG], stdout=subprocess.PIPE) as process:
        assert process.stdout.read(2) == b"xx"
        process.send_signal(number)
        # The workers have the pipe, too: it ends when the last of them has.
        process.communicate(timeout=20)
        assert process.returncode == -number
