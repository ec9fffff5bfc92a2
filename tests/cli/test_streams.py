"""A pipe that closes, a stream that is closed or cannot be written to ends no command."""

import io
import json
import os
import shlex
import subprocess
import sys
import threading

import pytest
from support.scenes import write_tiny_scene

from crossgrad_core.cli import streams

CROSSGRAD = [sys.executable, "-m", "crossgrad_core"]


@pytest.fixture
def pipe():
    """The end to read from, and the end to write to as a process has its stdout."""
    read, write = os.pipe()
    with open(read, "rb") as reader, open(write, "w", encoding="utf-8") as stdout:
        yield reader, stdout


def test_what_is_written_arrives(pipe):
    reader, stdout = pipe
    stream = streams._lasting(stdout)
    stream.write("Łódź\n")
    stream.flush()
    assert reader.readline() == "Łódź\n".encode()


def test_what_nobody_reads_is_swallowed(pipe):
    reader, stdout = pipe
    stream = streams._lasting(stdout)
    reader.close()
    for _ in range(3):
        stream.write("x" * 100_000)
        stream.flush()


def test_a_reader_that_is_slow_gets_everything_even_if_writes_do_not_wait(pipe):
    reader, stdout = pipe
    os.set_blocking(stdout.fileno(), False)
    stream = streams._lasting(stdout)
    found = []
    slow = threading.Timer(0.2, lambda: found.append(len(reader.read())))
    slow.start()
    stream.write("x" * 1_000_000)  # more than a pipe holds
    stream.flush()
    stdout.close()
    slow.join()
    assert found == [1_000_000]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_full_disk_below_the_terminal_is_swallowed(monkeypatch):
    with open("/dev/full", "w", encoding="utf-8", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", streams._lasting(full))
        sys.stderr.write("x" * 100_000 + "\n")
        sys.stderr.flush()


def test_streams_of_another_kind_stay_as_they_are():
    other = io.StringIO()
    assert streams._lasting(other) is other


@pytest.mark.parametrize("redirections", ["| head -1", ">&-", "2>&-", ">&- 2>&-", ">&- 2>&- <&-"])
def test_listing_for_nobody_ends_quietly(redirections):
    command = f"{shlex.quote(sys.executable)} -m crossgrad_core plugins list"
    script = f"set -o pipefail; {command} {redirections}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout in {"", "backbones\n"} or ">&-" in redirections


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=5)


def test_a_training_outlasts_the_readers_of_its_output(scene, tmp_path):
    out = tmp_path / "run"
    command = [*CROSSGRAD, "run", str(scene), "--steps", "20", "--threads", "1", "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:
        process.stderr.readline()
        process.stderr.close()
        process.stdout.close()
        assert process.wait() == 0
    assert json.loads((out / "summary.json").read_text())["status"] == "finished"
    log = (out / "log.txt").read_text()
    assert "step 20/20 (100 %)" in log and "run finished" in log and "PSNR" in log
