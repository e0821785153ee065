"""Runs jobs: in this process, or by workers of dask.distributed, on this machine or a cluster.

No result is lost when a process dies, see `runner`. dask replaces workers that die and reassigns their jobs, which
continue from their checkpoints; it gives up a job that kills the workers that take it.
"""

import dataclasses
import logging
import os
import queue
import re
import secrets
import signal
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from foldgauss._runtime.checks import is_integer, require
from foldgauss._runtime.optional_imports import import_optional
from foldgauss._runtime.threads import available_cores
from foldgauss.jobs.job import FitJob, read_record
from foldgauss.jobs.runner import Report, Stopped, fit_job
from foldgauss.video import FitInfo

if TYPE_CHECKING:
    from distributed import Client

#: Workers of this machine that a job may kill before it is given up.
DEATHS = 9
#: Seconds that workers have to write their checkpoints once they are asked to stop.
GRACE_SECONDS = 60.0
#: The addresses that dask accepts.
_ADDRESS = re.compile(r"((tcp|tls|ucx|ucxx|ws|wss)://)?[^/\s]+:[0-9]{1,5}/?")
#: Seconds without workers after which the jobs are given up.
NO_WORKERS_SECONDS = 120.0
#: Seconds that a scheduler has to answer.
CONNECT_SECONDS = 10.0
_POLL_SECONDS = 0.2


class SchedulerLost(OSError):
    """The scheduler is gone; finished jobs and checkpoints remain."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a job: its record, or the reason for its failure in one line."""

    job: FitJob
    record: dict[str, Any] | None = None
    failure: str | None = None


#: Receives the name of a running job and its last step, now and then.
OnProgress = Callable[[str, FitInfo], None]


def run_here(
    jobs: Sequence[FitJob], on_progress: OnProgress, *, should_stop: Callable[[], bool] = lambda: False
) -> Iterator[Outcome]:
    """Outcomes of the jobs, run one after another by this process.

    Raises `Stopped` once `should_stop` returns True and the running job has written its checkpoint.
    """
    for job in jobs:
        if should_stop():
            raise Stopped("stopped between two jobs")

        def report(info: FitInfo, name: str = job.name) -> bool:
            on_progress(name, info)
            return not should_stop()

        yield _run_job(job, report)


def _run_job(job: FitJob, report: Report) -> Outcome:
    """Run a job in this process; an error is its failure."""
    try:
        return Outcome(job, fit_job(job, report))
    except Stopped:
        raise
    except Exception as error:  # of any kind: the other jobs go on
        return Outcome(job, failure=one_line(error))


def one_line(error: BaseException) -> str:
    """The text of an error on one line, with its type where the text alone may not explain it."""
    text = " ".join(str(error).split())
    plain = isinstance(error, ValueError | OSError) and text
    return text if plain else f"{type(error).__name__}: {text}"[:300]


@contextmanager
def _silence_dask() -> Iterator[None]:
    """dask logs a traceback for each worker that dies; here outcomes report what matters."""
    names = ("distributed", "distributed.client", "tornado.application", "asyncio")
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


@contextmanager
def local_workers(count: int, *, threads: int | None = None) -> Iterator["Client"]:
    """The dask client of `count` processes of this machine, with `threads` each (default: an equal part of the cores).

    Workers end with this process, however it ends, and are replaced when they die. They import the program that starts
    them: call this under `if __name__ == "__main__":`, or no worker will start.

    Raises ValueError for invalid counts, ImportError if dask.distributed is not installed.
    """
    for name, value in (("workers", count), ("threads", 1 if threads is None else threads)):
        require(is_integer(value, 1), name, expected="a whole number >= 1", got=repr(value))
    distributed, dask = import_optional("distributed", "distributed"), import_optional("dask", "distributed")

    threads = max(1, available_cores() // count) if threads is None else threads
    environment = {"FOLDGAUSS_NUM_THREADS": str(threads)}
    if threads == 1:
        flags = os.environ.get("XLA_FLAGS", "")
        environment["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    settings = {
        "distributed.worker.profile.enabled": False,
        "distributed.scheduler.allowed-failures": DEATHS - 1,
        "distributed.admin.system-monitor.gil.enabled": False,
    }
    with ExitStack() as stack, _silence_dask():
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="foldgauss-", ignore_cleanup_errors=True))
        stack.enter_context(dask.config.set(settings))
        cluster = distributed.LocalCluster(
            n_workers=0,  # scaled below: a worker that dies while it starts must not raise
            threads_per_worker=1,
            processes=True,
            memory_limit=None,  # a worker stopped for its memory would be stopped again
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # any port: two commands may run at once
            local_directory=scratch,
            silence_logs=50,
            env=environment,
            preload=["foldgauss._runtime.worker"],
        )
        stack.enter_context(cluster)
        cluster.loop.add_callback(_block_ctrl_c)
        client = stack.enter_context(distributed.Client(cluster, set_as_default=False))
        cluster.scale(count)
        yield client


def _block_ctrl_c() -> None:
    """Block SIGINT on the thread that starts workers, and so in them: a terminal sends Ctrl-C to all processes."""
    if hasattr(signal, "pthread_sigmask"):  # not Windows
        resource_tracker.ensure_running()  # otherwise the first worker starts it, which removes the block
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextmanager
def running_cluster(address: str) -> Iterator["Client"]:
    """The workers of the scheduler at `address`, as tcp://host:8786.

    They must find clips and outputs by the same paths. Start them with one thread each, `dask worker --nthreads 1`: a
    job has threads of its own.

    Raises `SchedulerLost` if no scheduler answers, ImportError if dask.distributed is not installed.
    """
    distributed = import_optional("distributed", "distributed")
    require(
        _ADDRESS.fullmatch(address),
        "scheduler",
        expected="an address as tcp://host:8786",
        got=repr(address),
        cure="`dask scheduler` prints it when it starts.",
    )
    with _silence_dask():
        try:
            client = distributed.Client(address, set_as_default=False, timeout=CONNECT_SECONDS)
        except (OSError, TimeoutError, ValueError) as error:
            got = f"{address!r}, which does not answer ({one_line(error)})"
            text = f"scheduler: expected the address of a running scheduler, got {got}."
            raise SchedulerLost(f"{text} Start one: dask scheduler; dask worker ADDRESS --nthreads 1.") from error
        with client:
            yield client


def run_on(
    client: "Client",
    jobs: Sequence[FitJob],
    on_progress: OnProgress,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[Outcome]:
    """Outcomes of the jobs in the order in which they end, run by the workers of a dask client.

    Raises `Stopped` once `should_stop` returns True and the workers have written their checkpoints, `SchedulerLost`.
    """
    from distributed import Event

    waiting: deque[FitJob] = deque()
    for job in jobs:
        if record := read_record(job):  # finished already
            yield Outcome(job, record)
        else:
            waiting.append(job)
    topic = f"foldgauss-{secrets.token_hex(6)}"
    running: list[tuple[Any, FitJob]] = []
    stop, events = Event(topic, client=client), queue.SimpleQueue()
    # Events arrive on the client's own thread; `on_progress` is called on this one.
    client.subscribe_topic(topic, lambda event: events.put(event[1]))
    seen = time.monotonic()  # when there were workers
    try:
        while waiting or running:
            threads = _count_threads(client)
            seen = time.monotonic() if threads else seen
            if time.monotonic() - seen > NO_WORKERS_SECONDS:
                cure = _NONE_HERE if client.cluster else _NONE_THERE
                raise SchedulerLost(f"No worker for {NO_WORKERS_SECONDS:g} s. Finished jobs are kept: {cure}.")
            while waiting and len(running) < threads:  # no more: dask blames all jobs of a worker that dies
                job = waiting.popleft()
                running.append((client.submit(_run_on_worker, job, topic, pure=False), job))
            time.sleep(_POLL_SECONDS)
            while not events.empty():
                name, *info = events.get()
                on_progress(name, FitInfo(*info))
            ended = [pair for pair in running if pair[0].done()]
            running = [pair for pair in running if pair not in ended]
            for future, job in ended:
                yield _outcome(future, job)
            if should_stop():
                stop.set()
                until = time.monotonic() + GRACE_SECONDS
                while time.monotonic() < until and not all(future.done() for future, _ in running):
                    time.sleep(_POLL_SECONDS)
                raise Stopped("stopped")
    finally:
        with suppress(Exception):  # the scheduler may be gone
            client.unsubscribe_topic(topic)
            client.cancel([future for future, _ in running])


def _count_threads(client: "Client") -> int:
    """Number of jobs that can run at once, now. Raises `SchedulerLost`."""
    try:
        if client.status in ("running", "connecting"):
            return sum(client.nthreads().values())
    except (OSError, TimeoutError) as error:
        raise SchedulerLost(_LOST) from error
    raise SchedulerLost(_LOST)


def _outcome(future: Any, job: FitJob) -> Outcome:
    """The outcome of a job that has ended."""
    from distributed import CancelledError, KilledWorker

    if future.status == "cancelled":
        raise SchedulerLost(_LOST)
    try:
        return future.result()
    except CancelledError as error:
        raise SchedulerLost(_LOST) from error
    except Stopped:
        raise
    except KilledWorker:
        cure = "Memory is probably short: use fewer workers, shorter segments or smaller frames."
        return Outcome(job, failure=f"{job.name}: its workers died repeatedly. {cure}")
    except Exception as error:  # of the worker, as where foldgauss is missing or of another version there
        return Outcome(job, failure=one_line(error))


_NONE_HERE = (
    "they die while they start, for the reason above; a program of your own must start them under "
    '`if __name__ == "__main__":`'
)
_NONE_THERE = "start some, dask worker ADDRESS --nthreads 1, and run the command again"
_LOST = "The scheduler does not answer any more. Finished jobs are kept: start one, and run the command again."


def _run_on_worker(job: FitJob, topic: str) -> Outcome:
    """Runs on a worker: the outcome of a job."""
    from distributed import Event, get_worker

    worker = get_worker()
    stop = Event(topic)

    def report(info: FitInfo) -> bool:
        worker.log_event(topic, (job.name, *info))
        return not stop.is_set()

    return _run_job(job, report)
