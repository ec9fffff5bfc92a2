"""Jobs that threads share, and where the threads run."""

import os
import sys
import threading
import time
import weakref
from contextlib import contextmanager

import numba
import numpy as np
import pytest

from crossgrad_core.numerics import jobs
from crossgrad_core.numerics.jit import kernel
from crossgrad_core.system import cores


@kernel
def mark(numbers, marks):
    job = jobs.next_job(numbers, marks.shape[0])
    while job < marks.shape[0]:
        marks[job] += 1
        job = jobs.next_job(numbers, marks.shape[0])


@pytest.fixture(params=[1, 2])
def threads(request):
    if request.param > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("fewer threads here")
    before = numba.get_num_threads()
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 1000])
@pytest.mark.parametrize("run", [jobs.parallel, jobs.serial])
def test_every_job_is_done_once(threads, run, count):
    marks = np.zeros(count, np.int64)
    run(mark, marks)
    assert (marks == 1).all()


@kernel
def taken(numbers, count, most):
    found = np.empty(most, np.int64)
    for place in range(most):
        found[place] = jobs.next_job(numbers, count)
    return found


def test_a_thread_takes_its_own_jobs_first_and_then_jobs_of_other_threads():
    first, second, third = jobs._jobs(3)
    assert list(taken(second, 10, 2)) == [3, 4]
    assert list(taken(third, 10, 5)) == [6, 7, 8, 9, 0]
    assert list(taken(first, 10, 2)) == [1, 2]
    assert list(taken(second, 10, 3)) == [5, 10, 10]
    assert list(taken(first, 10, 1)) == list(taken(third, 10, 1)) == [10]


@pytest.mark.parametrize(("threads", "count"), [(1, 7), (4, 0), (4, 3), (5, 64)])
def test_threads_in_any_order_do_every_job_once(threads, count):
    draw = np.random.default_rng(threads * 100 + count)
    numbers = jobs._jobs(threads)
    found = [taken(numbers[draw.integers(threads)], count, 1)[0] for _ in range(count)]
    assert sorted(found) == list(range(count))
    assert all(taken(each, count, 1)[0] == count for each in numbers)


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_an_error_of_a_helper_thread_is_raised(threads):
    both = threading.Barrier(threads)

    def fails(_numbers):
        both.wait(timeout=30)
        if threading.current_thread() is not threading.main_thread():
            raise ValueError("of a helper")

    with pytest.raises(ValueError, match="of a helper"):
        jobs.parallel(fails)


@contextmanager
def occupied_helper():
    """The helper has something else to do meanwhile."""
    busy, enough = threading.Event(), threading.Event()

    def occupied():
        busy.set()
        assert enough.wait(timeout=30)

    jobs._helpers(os.getpid()).ask([call := jobs._Call(occupied)])
    assert busy.wait(timeout=30)
    yield
    enough.set()
    call.end()
    assert call.error is None


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_parallel_does_not_wait_for_a_busy_helper(threads):
    marks = np.zeros(1000, np.int64)
    with occupied_helper():
        jobs.parallel(mark, marks)
    assert (marks == 1).all()


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_background_work_is_complete_after_end(threads, count):
    marks = np.zeros(count, np.int64)
    begun = jobs.Begun(mark, marks)
    assert threads > 1 or (marks == 1).all()
    for _ in range(2):
        begun.end()
        assert (marks == 1).all()


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_parallel_works_while_background_work_runs(threads):
    enough, marks = threading.Event(), np.zeros(1000, np.int64)

    def waits(_numbers):
        assert enough.wait(timeout=30)

    begun = jobs.Begun(waits)
    jobs.parallel(mark, marks)
    assert (marks == 1).all()
    enough.set()
    begun.end()


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_an_error_of_background_work_is_raised_at_every_end(threads):
    def fails(_numbers):
        if threading.current_thread() is not threading.main_thread():
            raise ValueError("of a helper")
        ended.wait(timeout=30)

    ended = threading.Event()
    begun = jobs.Begun(fails)
    jobs._helpers(os.getpid()).ask([after := jobs._Call(ended.set)])
    for _ in range(2):
        with pytest.raises(ValueError, match="of a helper"):
            begun.end()
    begun.leave()
    after.end()


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_abandoned_background_work_is_not_continued(threads):
    marks = np.zeros(1000, np.int64)
    with occupied_helper():
        jobs.Begun(mark, marks).leave()
    over = threading.Event()
    jobs._helpers(os.getpid()).ask([jobs._Call(over.set)])
    assert over.wait(timeout=30)
    assert (marks == 0).all()


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_helper_threads_keep_no_reference_to_their_arguments(threads):
    marks = np.zeros(1000, np.int64)
    left = weakref.ref(marks)
    jobs.parallel(mark, marks)
    del marks
    # A call that was not needed is dropped as soon as its helper comes to it.
    for _ in range(100):
        if left() is None:
            break
        time.sleep(0.05)
    assert left() is None


@pytest.mark.parametrize("threads", [2], indirect=True)
def test_helper_threads_end_before_the_interpreter_and_are_replaced_on_the_next_call(
    threads, monkeypatch
):
    at_exit = []
    monkeypatch.setattr(jobs.atexit, "register", at_exit.append)
    jobs._helpers.cache_clear()
    marks = np.zeros(1000, np.int64)
    jobs.parallel(mark, marks)
    (dismiss,) = at_exit
    (thread,) = [thread for _, thread in jobs._helpers(os.getpid())._helpers]
    assert thread.is_alive()
    dismiss()
    assert not thread.is_alive()
    jobs.parallel(mark, marks)
    assert (marks == 2).all()
    dismiss()
    jobs._helpers.cache_clear()  # Nobody would end the helpers of these at the exit.


linux = pytest.mark.skipif(
    sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2, reason="needs two cores of Linux"
)


@linux
@pytest.mark.parametrize("threads", [2], indirect=True)
def test_helper_threads_run_on_other_cores_than_their_caller(threads, monkeypatch):
    allowed = os.sched_getaffinity(0)
    jobs._helpers.cache_clear()
    for core in sorted(allowed) * 2:
        monkeypatch.setattr(jobs, "current_core", lambda core=core: core)
        both, found = threading.Barrier(threads), {}

        def look(_numbers, both=both, found=found):
            both.wait(timeout=30)
            found[threading.current_thread() is threading.main_thread()] = os.sched_getaffinity(0)

        jobs.parallel(look)
        assert found == {True: allowed, False: allowed - {core}}


@linux
def test_a_thread_without_another_allowed_core_is_not_moved(monkeypatch):
    allowed = os.sched_getaffinity(0)
    core = cores.current_core()
    assert core in allowed
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {core})
    cores.keep_off(core, [threading.get_native_id()])
    monkeypatch.undo()
    assert os.sched_getaffinity(0) == allowed
    cores.keep_off(None, [threading.get_native_id()])
    assert os.sched_getaffinity(0) == allowed


@linux
def test_a_thread_that_has_ended_is_skipped():
    ended = threading.Thread(target=lambda: None)
    ended.start()
    number = ended.native_id
    ended.join()
    cores.keep_off(min(os.sched_getaffinity(0)), [number])


@pytest.mark.parametrize(("wish", "found"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_idle_threads_sleep_unless_the_environment_sets_a_wait_policy(monkeypatch, wish, found):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if wish is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", wish)
    cores.let_idle_threads_sleep()
    assert os.environ["OMP_WAIT_POLICY"] == found
