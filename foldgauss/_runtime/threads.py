"""The pool of worker threads that runs serial `nogil` kernels.

Numba's own threading aborts after `fork` (OpenMP) and fails from two Python threads at once (workqueue).
A pool that runs serial kernels over ranges of work has neither problem, and since the ranges do not depend on the
number of threads, results are the same to the bit for any number.
"""

import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from foldgauss._runtime.checks import is_integer, require

_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_num_threads: int | None = None
_local = threading.local()  # `in_task`: whether this thread runs a task of several


def available_cores() -> int:
    """Cores this process may run on (its affinity, where the system reports it)."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def num_threads() -> int:
    """Threads the kernels use: as set by `set_num_threads`, else FOLDGAUSS_NUM_THREADS, else the number of cores."""
    if _num_threads is not None:
        return _num_threads
    setting = os.environ.get("FOLDGAUSS_NUM_THREADS")
    if setting is None:
        return available_cores()
    require(
        setting.isdecimal() and int(setting) >= 1,
        "FOLDGAUSS_NUM_THREADS",
        expected="a whole number >= 1",
        got=repr(setting),
    )
    return int(setting)


def set_num_threads(count: int | None) -> None:
    """Fix the number of kernel threads; None returns to the default."""
    global _pool, _num_threads
    require(
        count is None or is_integer(count, 1),
        "count",
        expected="a whole number >= 1, or None",
        got=count,
    )
    with _lock:
        _num_threads, _pool = count, None


def _jax_has_started() -> bool:
    """Whether JAX has started its threads, which importing it does not; there is no public API for this."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None:
        return False
    started = getattr(bridge, "backends_are_initialized", None)
    return started is None or started()


def _begin_child() -> None:
    """In a forked child the threads of the pool and of JAX do not exist: reset the pool, and make JAX raise, not hang.

    Without its caches JAX traces every function anew, and tells the listener, which raises. Only Numba kernels work.
    """
    global _pool, _lock
    _pool, _lock = None, threading.Lock()
    if _jax_has_started():
        import jax

        jax.clear_caches()
        jax.monitoring.register_event_duration_secs_listener(_refuse_jax)


def _refuse_jax(event: str, seconds: float, **about: object) -> None:
    raise RuntimeError(
        f"process {os.getpid()}: expected one with JAX's threads, got one that was forked after JAX had started, "
        "where it would hang. Start processes by spawn: multiprocessing.get_context('spawn'), or "
        "ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn')); or fork before anything is computed."
    )


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_child)


def _call(task: Callable[[int], object], item: int) -> None:
    """`task(item)`; a KeyboardInterrupt that Numba turned into a SystemError is raised again."""
    try:
        task(item)
    except SystemError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, KeyboardInterrupt):
            cause = cause.__cause__ or cause.__context__
        if cause is None:
            raise
        raise KeyboardInterrupt from error


def run_tasks(task: Callable[[int], object], items: Iterable[int], *, serial: bool = False) -> None:
    """Call `task(item)` for every item on the pool, or all on this thread, and wait; the first error is raised here.

    What a task of several calls itself runs on its thread. If no more threads can be started, fewer are used.
    """
    global _pool
    items = list(items)
    if serial or len(items) <= 1 or num_threads() == 1 or getattr(_local, "in_task", False):
        for item in items:
            _call(task, item)
        return
    threads = num_threads()
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(threads, thread_name_prefix="foldgauss")
        pool = _pool
    # One queue entry per thread, not per item: a Python future costs about as much as a small tile.
    pending = iter(items)
    guard = threading.Condition()
    errors: list[BaseException] = []
    at_work: list[None] = []  # one entry for each thread of the pool that takes items

    def drain() -> None:
        while True:
            try:
                with guard:
                    item = next(pending, None)
                if item is None:
                    return
                _local.in_task = True
                _call(task, item)
            except BaseException as error:
                errors.append(error)
                return
            finally:
                _local.in_task = False

    def drain_on_pool() -> None:
        with guard:
            at_work.append(None)
        drain()
        with guard:
            at_work.pop()
            guard.notify()

    try:
        with suppress(RuntimeError):  # no more threads can be started
            for _ in range(min(threads, len(items)) - 1):
                pool.submit(drain_on_pool)
        drain()  # the calling thread works too
    finally:
        # Wait for all: arrays that they use may be freed once this returns.
        with guard:
            pending = iter(())
        while at_work:
            try:
                with guard:
                    guard.wait_for(lambda: not at_work)
            except KeyboardInterrupt as error:
                errors.insert(0, error)
    if errors:
        raise errors[0]
