"""A machine divided among workers: no core twice, no memory twice."""

import pytest

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep import machine
from crossgrad_plugins.sweep.machine import divided

GIB = 2**30


@pytest.fixture
def has(monkeypatch):
    def make(cores, gib):
        monkeypatch.setattr(machine, "available_cores", lambda: tuple(cores))
        available = None if gib is None else int(gib * GIB)
        monkeypatch.setattr(machine, "available_memory", lambda: available)

    return make


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("workers", [None, 1, 2])
def test_each_available_core_is_assigned_at_most_once(has, threads, workers):
    ours = (3, 4, 5, 8, 9, 11)
    has(ours, 64)
    found = divided(workers, threads, None)
    assert len(found.cores) == (workers or 6 // threads)
    given = [core for cores in found.cores for core in cores]
    assert all(len(cores) == threads for cores in found.cores)
    assert len(set(given)) == len(given) and set(given) <= set(ours)
    assert found.memory * len(found.cores) <= 0.9 * 64 * GIB


def test_little_memory_means_fewer_workers(has):
    has(range(16), 5)
    assert len(divided(None, 1, None).cores) == 3
    assert len(divided(None, 1, 2.0).cores) == 2
    assert divided(None, 1, 2.0).memory == 2 * GIB
    has(range(16), 0.5)
    assert len(divided(None, 1, None).cores) == 1


def test_without_a_known_memory_size_there_is_no_memory_limit(has):
    has(range(4), None)
    assert divided(None, 2, None).memory is None
    assert divided(3, 1, 1.5).memory == 3 * GIB // 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [((5, 1, None), "--workers"), ((None, 5, None), "--threads"), ((2, 1, 5.0), "--workers"),
     ((None, 1, 20.0), "--memory")],
)  # fmt: skip
def test_more_workers_or_threads_than_available_are_refused(has, arguments, named):
    has(range(4), 8)
    with pytest.raises(UserError) as caught:
        divided(*arguments)
    assert named in caught.value.where and caught.value.expected


def counts(**busy):
    """Two looks at the counts of cores: all of 100 ticks in between, of which so many were work."""
    first = "cpu  1 2 3 4 5\n" + "".join(f"{name} 7 0 0 70 1 0\n" for name in busy) + "intr 9\n"
    rows = (f"{name} {7 + ticks} 0 0 {170 - ticks} 1 0\n" for name, ticks in busy.items())
    return [first, "cpu  1 2 3 4 5\n" + "".join(rows) + "intr 9\n"]


@pytest.mark.parametrize(
    ("busy", "expected"),
    [
        ({"cpu0": 100, "cpu1": 0, "cpu2": 100, "cpu3": 3}, (1, 3, 0, 2)),
        ({"cpu0": 20, "cpu1": 0, "cpu2": 10, "cpu3": 0}, (0, 1, 2, 3)),
        ({"cpu0": 50, "cpu1": 40, "cpu2": 100, "cpu3": 0}, (3, 0, 1, 2)),
        # Cores that are switched off are not listed.
        ({"cpu0": 100, "cpu3": 0}, (1, 2, 3, 0)),
        ({}, (0, 1, 2, 3)),
    ],
)
def test_a_sweep_uses_idle_cores_first(monkeypatch, tmp_path, busy, expected):
    looks = counts(**busy)
    file = tmp_path / "stat"
    monkeypatch.setattr(machine, "_COUNTS", file)
    file.write_text(looks[0])
    monkeypatch.setattr(machine.time, "sleep", lambda seconds: file.write_text(looks[1]))
    assert machine.idle_first((0, 1, 2, 3)) == expected


def test_cores_keep_their_order_without_load_counts(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "_COUNTS", tmp_path / "no-such-file")
    assert machine.idle_first((4, 2)) == (4, 2)


def test_idle_cores_are_selected_only_if_cores_are_left_over(has, monkeypatch):
    has(range(4), 64)
    monkeypatch.setattr(machine, "idle_first", lambda cores: cores[::-1])
    assert divided(2, 1, None).cores == ((3,), (2,))
    assert divided(2, 2, None).cores == ((0, 1), (2, 3))
