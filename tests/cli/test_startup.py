"""A command says at once what it does, and shows compiling only where it compiles."""

import logging
import re
import subprocess
import sys
import time

import pytest

from crossgrad_core.system import startup

#: Notes the heavy modules at the first line, and ends.
FIRST_LINE = """
import sys

class Writing:
    def write(self, text):
        heavy = {"torch", "numba", "numpy", "PIL", "yaml"} & sys.modules.keys()
        print(*heavy, *text.split())
        sys.stdout.flush()
        sys.exit()

    def __getattr__(self, name):
        return getattr(sys.__stderr__, name)

sys.stderr = Writing()
from crossgrad_core.__main__ import main
main()
"""
LOG = logging.getLogger("crossgrad_core.numerics.kernel_cache")
STAGES = logging.getLogger("crossgrad_core.training.start")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "arguments",
    [("run", "SCENE"), ("eval", "RUN"), ("render", "RUN"), ("export", "RUN"), ("diagnose", "S"),
     ("stress", "sum")],
    ids=lambda arguments: arguments[0],
)  # fmt: skip
def test_the_first_line_is_printed_before_any_large_library_is_imported(arguments):
    command = [sys.executable, "-c", FIRST_LINE, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    words = done.stdout.split()
    assert words == ["crossgrad", words[1], "loading", "libraries"]


@pytest.fixture
def announced(monkeypatch):
    yield startup.announce
    startup.finish()


def test_each_stage_prints_a_line_and_kernels_are_reported_only_if_they_compile(announced, capsys):
    announced()
    STAGES.info("loading kernels")
    STAGES.debug("loaded")
    STAGES.info("training")
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == ["loading kernels", "training"]


def test_the_clock_of_compilation_also_runs_inside_a_kernel(announced, capsys, monkeypatch):
    monkeypatch.setattr(startup, "PLAIN_INTERVAL", 0.02)
    announced()
    STAGES.info("loading kernels")
    LOG.info("compiling %s", "outer")
    LOG.info("compiling %s", "inner")
    time.sleep(0.1)
    LOG.info("compiled %s", "inner")
    LOG.info("compiled %s", "outer")
    time.sleep(0.05)
    quiet = capsys.readouterr().err.splitlines()
    time.sleep(0.1)
    assert capsys.readouterr().err == ""  # nothing is compiled now
    STAGES.debug("loaded")
    assert quiet[2] == startup._EXPLANATION
    assert len(quiet) > 4 and set(quiet[3:]) == {f"{startup._EXPLANATION}: 0 s"}
    assert capsys.readouterr().err == "compiled in 0 s\n"


def test_a_log_shows_two_lines_for_a_minute_of_compiling_and_names_no_kernel(announced, capsys):
    announced()
    for name in ("one", "two", "three"):
        LOG.info("compiling %s", name)
        time.sleep(0.05)
        LOG.info("compiled %s", name)
    STAGES.debug("loaded")
    assert startup.PLAIN_INTERVAL >= 60
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == [startup._EXPLANATION, "compiled in 0 s"]


def test_compiling_takes_one_line_on_a_terminal(announced, capsys, monkeypatch):
    monkeypatch.setattr(startup, "TERMINAL_INTERVAL", 0.02)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    announced()
    LOG.info("compiling %s", "one")
    shown, clock = "", re.compile(re.escape(f"\r\x1b[K{startup._EXPLANATION}: ") + r"\d+ s")
    # A busy machine may not run the thread that draws the line for a while.
    latest = time.monotonic() + 60
    while len(clock.findall(shown)) < 2 and time.monotonic() < latest:
        time.sleep(0.02)
        shown += capsys.readouterr().err
    STAGES.debug("loaded")
    lines = (shown + capsys.readouterr().err).split("\n")
    assert len(lines) == 3 and lines[-1] == ""
    assert len(clock.findall(lines[1])) > 1
    assert re.search(r"\r\x1b\[Kcompiled in \d+ s$", lines[1])
    # A line that is longer than the terminal could not be overwritten.
    assert len(f"{startup._EXPLANATION}: 999 s") <= 80


def test_quiet_prints_warnings_only(announced, capsys):
    announced(quiet=True)
    STAGES.info("loading kernels")
    LOG.info("compiling %s", "one")
    LOG.warning("kernels cannot be saved")
    assert capsys.readouterr().err == "note: kernels cannot be saved\n"


def test_an_error_is_printed_after_the_last_stage(announced, capsys, tmp_path):
    from crossgrad_core.cli.main import main

    with pytest.raises(SystemExit, match="2"):
        main(["run", str(tmp_path / "none")])
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith("loading libraries") and lines[1].startswith("reading scene")
    assert lines[2].startswith("error: ")
    assert not logging.getLogger("crossgrad_core").handlers
