"""Detection of a terminal that can show a progress bar."""

import io
import os
import pty
import struct

import pytest

from crossgrad_core.system.terminal import is_live

fcntl = pytest.importorskip("fcntl")
termios = pytest.importorskip("termios")


@pytest.fixture
def terminal(monkeypatch):
    """A terminal of so many columns."""
    monkeypatch.setenv("TERM", "xterm")
    opened = []

    def of(columns):
        ends = pty.openpty()
        opened.extend(ends)
        size = struct.pack("HHHH", 0, columns, 0, 0)
        fcntl.ioctl(ends[1], termios.TIOCSWINSZ, size)
        return os.fdopen(os.dup(ends[1]), "w")

    yield of
    for end in opened:
        os.close(end)


@pytest.mark.parametrize(("columns", "live"), [(80, True), (1, True), (0, False)])
def test_a_terminal_without_columns_gets_no_progress_bar(terminal, columns, live):
    with terminal(columns) as stream:
        assert is_live(stream) is live


def test_a_dumb_terminal_gets_no_progress_bar(terminal, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    with terminal(80) as stream:
        assert not is_live(stream)


def test_a_file_is_not_a_terminal():
    assert not is_live(io.StringIO())
