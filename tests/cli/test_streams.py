"""A pipe that closes, a stream that is closed or cannot be written to ends no command."""

import io
import json
import os
import shlex
import subprocess
import sys
import threading
from contextlib import ExitStack

import pytest
from support.commands import ended
from support.scenes import write_tiny_scene

from crossgrad_core.cli import streams
from crossgrad_core.system.terminal import controls_of

CROSSGRAD = [sys.executable, "-m", "crossgrad_core"]


@pytest.fixture
def pipe():
    """The end to read from, and the end to write to as a process has its stdout."""
    read, write = os.pipe()
    with open(read, "rb") as reader, open(write, "w", encoding="utf-8") as stdout:
        yield reader, stdout


def test_written_text_reaches_the_reader(pipe):
    reader, stdout = pipe
    stream = streams._lasting(stdout)
    stream.write("Łódź\n")
    stream.flush()
    assert reader.readline() == "Łódź\n".encode()


def test_writing_to_a_closed_pipe_raises_nothing(pipe):
    reader, stdout = pipe
    stream = streams._lasting(stdout)
    reader.close()
    for _ in range(3):
        stream.write("x" * 100_000)
        stream.flush()


def test_a_slow_reader_of_a_nonblocking_pipe_gets_all_output(pipe):
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
def test_writing_to_a_full_disk_raises_nothing(monkeypatch):
    with open("/dev/full", "w", encoding="utf-8", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", streams._lasting(full))
        sys.stderr.write("x" * 100_000 + "\n")
        sys.stderr.flush()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_control_characters_and_characters_outside_the_encoding_are_escaped(encoding):
    read, write = os.pipe()
    with open(read, "rb") as reader, open(write, "w", encoding=encoding) as stdout:
        stream = streams._lasting(stdout)
        stream.write("Ł\x1b[31m \u202e \udcff\r\n")
        controls_of(stream).write("\x1b[K")
        stream.flush()
        letter = "Ł".encode(encoding, "backslashreplace")
        assert reader.readline() == letter + rb"\x1b[31m \u202e \udcff\r" + b"\n"
        assert reader.read(3) == b"\x1b[K"


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A run in a folder whose name no ASCII terminal can show."""
    place = tmp_path_factory.mktemp("foreign")
    scene = write_tiny_scene(place / "Łódź\x1b[31m", views=5)
    options = ("--steps", "2", "--threads", "1", "-q")
    done = in_ascii("run", scene, *options, "--out", place / "żółw\x1b[31m")
    return place / "żółw\x1b[31m", done


def in_ascii(*arguments):
    return subprocess.run(
        [*CROSSGRAD, *map(os.fspath, arguments)],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        check=False,
    )


@pytest.mark.slow
def test_a_run_prints_its_results_folder_on_every_terminal(foreign):
    folder, done = foreign
    assert done.returncode == 0, done.stderr
    assert rb"results in" in done.stdout and rb"\u017c\xf3\u0142w\x1b[31m" in done.stdout
    log = (folder / "log.txt").read_text(encoding="utf-8")
    assert r"Łódź\x1b[31m" in log and "\x1b" not in log


@pytest.mark.slow
@pytest.mark.parametrize("command", ["export", "render", "compare"])
def test_a_command_prints_its_output_path_on_every_terminal(
    foreign, command, tmp_path, monkeypatch
):
    out = tmp_path / "ó\x1b[31m"
    place = out.with_suffix(".ply") if command == "export" else out
    said = {name: tmp_path / name for name in ("stdout", "stderr")}
    with ExitStack() as files, monkeypatch.context() as patched:
        for name, path in said.items():
            patched.setattr(sys, name, files.enter_context(path.open("w", encoding="ascii")))
        streams.outlast_readers()  # As the command does with the streams of its process.
        assert ended(command, foreign[0], "--out", place) == 0, said["stderr"].read_bytes()
        sys.stdout.flush()
        sys.stderr.flush()
    stdout, stderr = (path.read_bytes() for path in said.values())
    assert rb"\xf3\x1b[31m" in stdout and b"\x1b" not in stdout + stderr
    assert place.exists()


@pytest.mark.parametrize("name", ["a" * 300, "/".join(["folder"] * 700), "a" * 250])
@pytest.mark.parametrize("command", ["run", "export", "render", "compare"])
def test_a_path_that_is_too_long_gives_one_error(command, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if len(name) < 255 and command != "export":
        pytest.skip("a folder may have that name")
    (tmp_path / "config.yaml").write_text("scene: s\nseed: 0\n")
    checkpoint = tmp_path / "checkpoints" / "step-000001"
    checkpoint.mkdir(parents=True)
    given = () if command == "run" else (tmp_path,)
    assert ended(command, *given, "--out", name) == 2
    said = capsys.readouterr().err
    assert said.count("error: ") == 1 and "the path is too long" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "config.yaml"]


def test_streams_of_another_kind_are_not_wrapped():
    other = io.StringIO()
    assert streams._lasting(other) is other


@pytest.mark.sampled(2)
@pytest.mark.parametrize("redirections", ["| head -1", ">&-", "2>&-", ">&- 2>&-", ">&- 2>&- <&-"])
def test_a_list_printed_to_a_closed_pipe_ends_quietly(redirections):
    command = f"{shlex.quote(sys.executable)} -m crossgrad_core plugins list"
    script = f"set -o pipefail; {command} {redirections}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout in {"", "backbones\n"} or ">&-" in redirections


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("scene") / "tiny", views=5)


@pytest.mark.slow
def test_a_training_continues_after_the_readers_of_its_output_end(scene, tmp_path):
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
