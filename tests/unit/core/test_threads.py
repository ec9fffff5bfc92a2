"""One number of threads for Numba and torch."""

import platform
import subprocess
import sys
import threading
from pathlib import Path

import numba
import pytest
import torch

from crossgrad_core.errors import UserError
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.system import cores as machine
from crossgrad_core.system.cores import available_cores


@pytest.fixture(autouse=True)
def _restored():
    before = numba.get_num_threads(), torch.get_num_threads()
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.mark.parametrize("n", range(1, numba.config.NUMBA_NUM_THREADS + 1))
def test_configure_threads_sets_numba_and_torch(n):
    assert configure_threads(n) == n
    assert numba.get_num_threads() == n
    assert torch.get_num_threads() == n


@pytest.mark.parametrize("n", [-1, 0, 10**6])
def test_an_impossible_number_of_threads_is_refused(n):
    most = numba.config.NUMBA_NUM_THREADS
    with pytest.raises(UserError, match="the number of threads is out of range") as error:
        configure_threads(n)
    # It may be that of a run from a larger machine, which nobody has typed.
    assert f"--threads {most}" in error.value.todo


@pytest.mark.parametrize(
    ("numba_value", "omp_value", "expected"),
    [("1", "", 1), ("", "1", 1), ("1", "9", 1), ("", "1,1", None), ("", "", None)],
)
def test_the_default_number_of_threads_comes_from_the_environment_or_the_cores(
    monkeypatch, numba_value, omp_value, expected
):
    monkeypatch.setenv("NUMBA_NUM_THREADS", numba_value)
    monkeypatch.setenv("OMP_NUM_THREADS", omp_value)
    most = numba.config.NUMBA_NUM_THREADS
    assert configure_threads(None) == (expected or min(available_cores(), most))


@pytest.mark.parametrize(
    ("content", "cores"), [("150000 100000", 2), ("50000 100000", 1), ("100000 100000", 1)]
)
def test_a_container_quota_limits_the_cores(monkeypatch, tmp_path, content, cores):
    limit = tmp_path / "cpu.max"
    limit.write_text(content)
    monkeypatch.setattr(machine, "_CGROUP_LIMIT", limit)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert available_cores() == cores


@pytest.mark.parametrize("content", ["max 100000", "", None])
def test_without_a_container_quota_the_number_of_cores_follows_the_cpu_affinity(
    monkeypatch, tmp_path, content
):
    limit = tmp_path / "cpu.max"
    if content is not None:
        limit.write_text(content)
    monkeypatch.setattr(machine, "_CGROUP_LIMIT", limit)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    assert available_cores() == 1


@pytest.mark.parametrize("variable", ["NUMBA_THREADING_LAYER", "NUMBA_THREADING_LAYER_PRIORITY"])
@pytest.mark.parametrize(("wish", "first"), [(None, "omp"), ("whatever", "workqueue")])
def test_openmp_is_preferred_unless_the_environment_selects_another_layer(
    monkeypatch, variable, wish, first
):
    monkeypatch.delenv("NUMBA_THREADING_LAYER", raising=False)
    monkeypatch.delenv("NUMBA_THREADING_LAYER_PRIORITY", raising=False)
    monkeypatch.setattr(numba.config, "THREADING_LAYER_PRIORITY", ["workqueue", "tbb", "omp"])
    if wish is not None:
        monkeypatch.setenv(variable, wish)
    configure_threads(1)
    assert numba.config.THREADING_LAYER_PRIORITY[0] == first


def test_backward_on_the_cpu_runs_in_the_calling_thread():
    seen = []

    class Probe(torch.autograd.Function):
        @staticmethod
        def forward(_ctx, x):
            return x.clone()

        @staticmethod
        def backward(_ctx, gradient):
            seen.append(threading.get_ident())
            return gradient

    Probe.apply(torch.ones(2, requires_grad=True)).sum().backward()
    assert seen == [threading.get_ident()]


PROGRAM = """
import resource

import numpy as np

from crossgrad_core.system.allocator import keep_freed_memory

keep_freed_memory()
for _ in range(4):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(6 << 20, np.uint8) for _ in range(8)]
    del arrays
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
print(faults)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_freed_memory_is_reused_without_page_faults():
    command = [sys.executable, "-c", PROGRAM]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    # 48 MiB are 12,288 pages.
    assert int(shown) < 500


LARGE_PAGES = """
import numpy as np

from crossgrad_core.system.allocator import KEPT, keep_freed_memory, use_large_pages


def asks(array):
    address, inside = array.ctypes.data + array.nbytes // 2, False
    for line in open("/proc/self/smaps"):
        words = line.split()
        if "-" in words[0]:
            first, end = (int(word, 16) for word in words[0].split("-"))
            inside = first <= address < end
        elif inside and words[0] == "VmFlags:":
            return "hg" in words


keep_freed_memory()
# More than the heap has room for: it grows, and asks for pages of the new part when it is told.
arrays = [np.empty(3 << 20, np.uint8) for _ in range(KEPT // (3 << 20) + 20)]
use_large_pages()
print(asks(arrays[20]), asks(arrays[-1]))
"""


@pytest.mark.skipif(
    not Path("/sys/kernel/mm/transparent_hugepage").exists(), reason="a system without large pages"
)
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_large_heap_arrays_request_huge_pages():
    command = [sys.executable, "-c", LARGE_PAGES]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert shown.strip() == "True True"
