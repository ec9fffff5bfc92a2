"""Fixtures that all tests share.

Runs do not draw their curve. Threads that wait do not spin: the processes of the tests share the
cores, and spinning took as much time as the work. Ctrl-C is not ignored, as it is in what a script
starts in the background.
"""

import gc
import logging
import os
import signal
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Before torch and numba are imported.

import pytest
from support.curves import DRAWN_BY, without_drawing
from xdist.scheduler import LoadFileScheduling

from crossgrad_core.run.results.curve import draw_curve

#: Their kernels take longest to compile and have none in common; many others share theirs.
HEAVIEST = ("rasterizers-numba-", "operators-cagrad-")
#: Components of which two processes would compile the same kernels at the same time.
SAME_KERNELS = ("[rules-", "[densifiers-multiview")
CONTRACTS, MATRIX, FAULTS = "test_contracts.py", "tests/matrix/", "tests/faults/"
GUARDS = "guards"


class ByFileOrComponent(LoadFileScheduling):
    """Tests of a file run in one process, which makes what they share once.

    Files of thousands of cases are divided: the contracts of a component stay together, as they
    compile the same kernels, and so do combinations of the same sampler or exposure. The tests of
    faults share a run that nothing happens to.
    """

    def _split_scope(self, nodeid):
        if CONTRACTS in nodeid:
            component = nodeid.rpartition("-")[0]
            together = (each for each in SAME_KERNELS if each in component)
            return next(together, component)
        if MATRIX in nodeid:
            return nodeid.partition(" x ")[0]
        if nodeid.startswith(FAULTS) and "FAULTS" not in os.environ:
            return FAULTS
        return super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """How tests are divided among processes."""
    return ByFileOrComponent(config, log)


@pytest.hookimpl(tryfirst=True)  # Before pytest applies `-m`.
def pytest_collection_modifyitems(items):
    """Mark cases as slow that `sampled` leaves out, and sort the tests.

    Contracts come first, so that no two processes compile a kernel that later tests load. Guards
    come last, because they are short and no process then waits long for the last test.
    """
    cases = defaultdict(list)
    for item in items:
        if item.get_closest_marker("sampled"):
            cases[item.nodeid.partition("[")[0]].append(item)
    for function in cases.values():
        (count,) = function[0].get_closest_marker("sampled").args
        kept = {len(function) * place // count for place in range(count)}
        for place, item in enumerate(function):
            if place not in kept:
                item.add_marker(pytest.mark.slow)

    def place(item):
        if item.path.name == CONTRACTS:
            return 0 if any(name in item.name for name in HEAVIEST) else 1
        return 2 + (item.path.parent.name == GUARDS)

    items.sort(key=place)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """While tests are collected, nothing becomes garbage; looking for it took a fifth of this.

    In a fresh checkout, one process compiles the tests and what they import; the others wait, and
    load it then.
    """
    gc.disable()
    compiled = Path(__file__).with_name("contract").glob("__pycache__/test_contracts.*-pytest-*")
    with Path(__file__).open() as lock:
        if not any(compiled):
            with suppress(ImportError, OSError):  # Not on Windows, nor on every file system.
                import fcntl

                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    fcntl.flock(lock, fcntl.LOCK_SH)
        return (yield)


def pytest_collection_finish():
    """What is there now stays: looking for garbage among a million objects takes a second.

    Before each phase of each test, pytest visits every logger that does not propagate; torch has
    forty of them.
    """
    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger) and logger.name.partition(".")[0] == "torch":
            logger.propagate = True
    forget_garbage()


def forget_garbage():
    gc.enable()
    # Tests and compilers make many objects that stay; looking after every 700 took a twentieth.
    gc.set_threshold(100_000, 20, 20)
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module")
def few_objects():
    """Checks of memory look at all objects after each step; what earlier tests left is skipped."""
    forget_garbage()


@pytest.fixture(scope="session", autouse=True)
def _undrawn():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DRAWN_BY, without_drawing)
        yield


@pytest.fixture(scope="session", autouse=True)
def _unsynced():
    """Nothing here cuts the power; waiting for the disk took up to a tenth of the tests of runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _compiling_alone():
    """A run starts no second process for its first missing kernel: the tests use every core."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("crossgrad_core.training.start.available_cores", lambda: 1)
        yield


@pytest.fixture
def drawn(monkeypatch):
    """Runs of this process draw their curve."""
    monkeypatch.setattr(DRAWN_BY, draw_curve)
