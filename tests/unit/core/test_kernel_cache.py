"""Compiled kernels on disk: what is damaged, stale or cannot be written never ends a run."""

import importlib
import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from crossgrad_core.numerics.kernel_cache import fingerprint

KERNEL = """
from crossgrad_core.numerics.jit import strict_kernel
from {package}.numba_kernels.constants import STEP


@strict_kernel
def moved(x):
    return x + STEP
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a kernel and, in a folder below, the constant that the kernel holds."""
    folder = tmp_path / f"kernels_{tmp_path.name}"
    inner = folder / "numba_kernels"
    inner.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (inner / "__init__.py").touch()
    (inner / "constants.py").write_text("STEP = 1\n")
    (folder / "fused.py").write_text(KERNEL.format(package=folder.name))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == folder.name]:
        del sys.modules[name]


def kernel(package):
    """The kernel as a new process sees it."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package.name]:
        del sys.modules[name]
    importlib.invalidate_caches()
    fingerprint.cache_clear()
    return importlib.import_module(f"{package.name}.fused").moved


def files(package):
    return sorted((package / "__pycache__").glob("*.nbc"))


def compiled(caplog):
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.INFO]
    return [text for text in said if text.startswith("compiling")]


@pytest.fixture(autouse=True)
def listening(caplog):
    caplog.set_level(logging.INFO, "crossgrad_core.numerics.kernel_cache")


def test_a_kernel_is_compiled_only_once(package, caplog):
    assert kernel(package)(1) == 2
    assert compiled(caplog) == ["compiling moved"]
    caplog.clear()
    assert kernel(package)(1) == 2
    assert compiled(caplog) == []
    assert kernel(package)(0.5) == 1.5  # another signature, another file
    assert compiled(caplog) == ["compiling moved"]
    assert len(files(package)) == 2


def flipped(content):
    """One bit in the middle, where the machine code is."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: b"garbage",
        lambda content: os.urandom(len(content)),
        lambda content: content[: len(content) // 2],
        flipped,
        lambda content: content + b"\0",
    ],
    ids=["empty", "garbage", "random", "cut", "bit", "longer"],
)
def test_a_damaged_cache_file_counts_as_missing_and_is_rewritten(package, caplog, damage):
    kernel(package)(1)
    (file,) = files(package)
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    caplog.clear()
    assert kernel(package)(1) == 2
    assert compiled(caplog) == ["compiling moved"]
    caplog.clear()
    assert kernel(package)(1) == 2
    assert compiled(caplog) == []


def test_a_folder_with_the_name_of_a_cache_file_gives_only_a_warning(package, caplog):
    kernel(package)(1)
    (file,) = files(package)
    file.unlink()
    file.mkdir()
    assert kernel(package)(1) == 2
    assert caplog.records[-1].levelno == logging.WARNING


def test_a_changed_constant_recompiles_the_kernel_and_deletes_the_old_file(package, caplog):
    assert kernel(package)(1) == 2
    old = files(package)
    (package / "numba_kernels" / "constants.py").write_text("STEP = 10\n")
    assert kernel(package)(1) == 11
    assert len(files(package)) == 1 and files(package) != old


def blocked(folder: Path) -> Path:
    """A path that no folder can be made at, not even by root, who may write to any folder."""
    folder.parent.mkdir(exist_ok=True)
    folder.touch()
    return folder


def test_the_cache_of_the_user_is_used_if_the_folder_of_the_kernel_is_read_only(
    package, caplog, monkeypatch, tmp_path
):
    blocked(package / "__pycache__")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert kernel(package)(1) == kernel(package)(1) == 2
    assert compiled(caplog) == ["compiling moved"]
    assert not [record for record in caplog.records if record.levelno == logging.WARNING]


def test_kernels_run_without_a_cache_folder_and_one_note_suggests_a_remedy(
    package, caplog, monkeypatch, tmp_path
):
    blocked(package / "__pycache__")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked(tmp_path / "user")))
    monkeypatch.setenv("HOME", str(tmp_path / "user" / "home"))
    assert kernel(package)(1) == kernel(package)(1) == 2
    (note,) = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert "NUMBA_CACHE_DIR=FOLDER" in note and str(package) in note
    assert compiled(caplog) == ["compiling moved"] * 2


def test_a_full_disk_only_disables_the_cache(package, caplog, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    assert kernel(package)(1) == 2
    (note,) = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert "No space left on device" in note
    assert not list((package / "__pycache__").glob("*.tmp"))


BOTH = """
import sys
import numpy as np
from {package}.fused import moved
x = np.dtype(sys.argv[1]).type(1)
print(moved(x), *[len(moved.stats.cache_misses)])
"""


@pytest.mark.slow
def test_two_processes_that_compile_at_once_save_both_kernels(package):
    program = BOTH.format(package=package.name)
    path = os.pathsep.join([str(package.parent), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": ""}

    def started(dtype):
        command = [sys.executable, "-c", program, dtype]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    for misses in (1, 0):
        running = [started("int64"), started("float64")]
        said = [process.communicate(timeout=120)[0].split() for process in running]
        assert said == [["2", str(misses)], ["2.0", str(misses)]]
    assert len(files(package)) == 2


def test_the_cache_key_of_a_bundled_kernel_covers_the_files_that_it_inlines():
    from crossgrad_core.numerics import kernel_cache
    from crossgrad_plugins.losses.photometric.numba_kernels import fused

    names = {path.name for path in kernel_cache._sources(Path(fused.__file__))}
    assert {"fused.py", "terms.py", "simd.py", "reference.py"} <= names


def test_cached_kernels_return_arrays_like_numba(package):
    assert np.array_equal(kernel(package)(np.arange(3)), [1, 2, 3])
