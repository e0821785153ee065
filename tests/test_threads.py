"""The pool that every kernel runs on."""

import threading
import time

import pytest

from foldgauss._runtime import threads as _threads


@pytest.fixture(autouse=True)
def default_threads():
    yield
    _threads.set_num_threads(None)


@pytest.mark.parametrize("count", [1, 2, 7])
@pytest.mark.parametrize("num_items", [0, 1, 3, 100])
def test_every_item_once(count, num_items):
    _threads.set_num_threads(count)
    done = []
    _threads.run_tasks(done.append, range(num_items))
    assert sorted(done) == list(range(num_items))


@pytest.mark.parametrize("count", [0, -1, 2.5])
def test_counts_are_whole_numbers(count):
    with pytest.raises(ValueError, match=r"^count: expected a whole number >= 1, or None, got "):
        _threads.set_num_threads(count)


@pytest.mark.parametrize("count", [1, 3])
def test_an_error_reaches_the_caller_and_the_pool_lives_on(count):
    _threads.set_num_threads(count)

    def fail(k):
        if k == 5:
            raise RuntimeError("five")

    with pytest.raises(RuntimeError, match="five"):
        _threads.run_tasks(fail, range(20))
    done = []
    _threads.run_tasks(done.append, range(4))
    assert len(done) == 4


def test_work_is_shared():
    _threads.set_num_threads(3)
    names = set()

    def work(_):
        names.add(threading.current_thread().name)
        time.sleep(0.02)

    _threads.run_tasks(work, range(12))
    assert len(names) == 3


def test_tasks_of_tasks_run_on_their_thread():
    """All of them once, also after an error; the next ones are shared again."""
    _threads.set_num_threads(3)
    outer, inner = {}, []

    def work(k):
        outer[k] = threading.current_thread()
        _threads.run_tasks(lambda j: inner.append((k, j, threading.current_thread())), range(5))
        if k == 7:
            raise RuntimeError("seven")
        time.sleep(0.01)

    with pytest.raises(RuntimeError, match="seven"):
        _threads.run_tasks(work, range(12))
    assert all(thread is outer[k] for k, _, thread in inner)
    assert sorted((k, j) for k, j, _ in inner) == [(k, j) for k in sorted(outer) for j in range(5)]
    test_work_is_shared()


def test_environment_variable(monkeypatch):
    monkeypatch.setenv("FOLDGAUSS_NUM_THREADS", "3")
    assert _threads.num_threads() == 3
    monkeypatch.setenv("FOLDGAUSS_NUM_THREADS", "many")
    with pytest.raises(ValueError, match="FOLDGAUSS_NUM_THREADS"):
        _threads.num_threads()


def test_an_interrupt_waits_for_the_workers():
    """What they read and write may be freed once the call has ended."""
    done, interrupted = [], threading.Event()

    def task(k):
        if threading.current_thread() is threading.main_thread():
            if not interrupted.is_set():
                interrupted.set()
                raise KeyboardInterrupt
            return
        interrupted.wait(10)
        time.sleep(0.2)
        done.append(k)

    _threads.set_num_threads(2)
    with pytest.raises(KeyboardInterrupt):
        _threads.run_tasks(task, range(2))
    finished = len(done)
    time.sleep(0.4)
    assert len(done) == finished
