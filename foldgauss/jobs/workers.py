"""Runs jobs: in this process, or by workers of dask.distributed, on this machine or a cluster.

No result is lost when a process dies, see `runner`. dask replaces workers that die and reassigns their jobs; a job that
kills every worker that takes it is given up here.
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
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from foldgauss._runtime.checks import invalid, is_integer
from foldgauss._runtime.threads import available_cores
from foldgauss.jobs.job import FitJob, read_record
from foldgauss.jobs.runner import Progress, Report, Stopped, fit_job

if TYPE_CHECKING:
    from distributed import Client

#: dask returns a job once so many of its workers have died.
DEATHS = 3
#: A job is given up after so many returns without a new checkpoint.
ROUNDS = 3
#: Seconds that workers have to write their checkpoints once they are asked to stop.
GRACE_SECONDS = 60.0
#: The addresses that dask accepts.
_ADDRESS = re.compile(r"((tcp|tls|ucx|ucxx|ws|wss)://)?[^/\s]+:[0-9]{1,5}/?")
#: Seconds without workers after which a warning is issued.
WARN_SECONDS = 10.0
#: Seconds without workers after which the jobs are given up.
NO_WORKERS_SECONDS = 120.0
#: Seconds that a scheduler has to answer.
CONNECT_SECONDS = 10.0
#: Seconds that workers of this machine may be missing before others are started; doubled each time.
RESTART_SECONDS = 20.0
_POLL_SECONDS = 0.2


class SchedulerLost(OSError):
    """The scheduler is gone; finished jobs and checkpoints remain."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The result of a job: its record, or the reason for its failure in one line."""

    job: FitJob
    record: dict[str, Any] | None = None
    failure: str | None = None


OnProgress = Callable[[Progress], None]


def run_here(
    jobs: Sequence[FitJob], on_progress: OnProgress, *, should_stop: Callable[[], bool] = lambda: False
) -> Iterator[Outcome]:
    """Outcomes of the jobs, run one after another by this process.

    Raises `Stopped` once `should_stop` returns True and the running job has written its checkpoint.
    """
    waiting = yield from _finished_outcomes(jobs)

    def report(progress: Progress) -> bool:
        on_progress(progress)
        return not should_stop()

    for job in waiting:
        if should_stop():
            raise Stopped("stopped between two jobs")
        yield _run_job(job, report)


def _finished_outcomes(jobs: Sequence[FitJob]) -> Generator[Outcome, None, list[FitJob]]:
    """Outcomes of the jobs that are finished already; returns the others."""
    waiting = []
    for job in jobs:
        record = read_record(job)
        if record is None:
            waiting.append(job)
        else:
            yield Outcome(job, record)
    return waiting


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


class WorkerPool:
    """Workers of dask.distributed, as yielded by `local_workers` and `running_cluster`."""

    def __init__(self, client: "Client", cluster: Any = None, count: int = 0):
        self.client, self._cluster, self._count = client, cluster, count
        self._since, self._patience = time.monotonic(), RESTART_SECONDS

    @property
    def is_remote(self) -> bool:
        """Whether its workers are started elsewhere."""
        return self._cluster is None

    @property
    def threads(self) -> int:
        """Number of jobs that can run at once, now. Raises `SchedulerLost`."""
        try:
            if self.client.status not in ("running", "connecting"):
                raise SchedulerLost(_LOST)
            return sum(self.client.nthreads().values())
        except (OSError, TimeoutError) as error:
            raise SchedulerLost(_LOST) from error

    def restart_missing(self, alive: int) -> None:
        """Start workers of this machine in place of those that stay away.

        dask replaces workers that die during a job, but not those that die while they start.
        """
        now = time.monotonic()
        if alive >= self._count:
            self._since, self._patience = now, RESTART_SECONDS
        elif now - self._since > self._patience:
            self._since, self._patience = now, 2 * self._patience  # starting takes long on a busy machine
            self._cluster.scale(alive)  # removes the missing workers first
            self._cluster.scale(self._count)


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
def local_workers(count: int, *, threads: int | None = None) -> Iterator["WorkerPool"]:
    """A pool of `count` processes of this machine with `threads` threads each (default: an equal part of the cores).

    Workers end with this process, however it ends, and are replaced when they die. They import the program that starts
    them: call this under `if __name__ == "__main__":`, or no worker will start.

    Raises ValueError for invalid counts, ImportError if dask.distributed is not installed.
    """
    for name, value in (("workers", count), ("threads", 1 if threads is None else threads)):
        if not is_integer(value, 1):
            raise invalid(name, expected="a whole number >= 1", got=repr(value))
    distributed = _import_distributed("workers")
    import dask

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
        pool = WorkerPool(stack.enter_context(distributed.Client(cluster, set_as_default=False)), cluster, count)
        cluster.scale(count)
        yield pool


def _block_ctrl_c() -> None:
    """Block SIGINT on the thread that starts workers, and so in them: a terminal sends Ctrl-C to all processes."""
    if hasattr(signal, "pthread_sigmask"):  # not Windows
        resource_tracker.ensure_running()  # otherwise the first worker starts it, which removes the block
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextmanager
def running_cluster(address: str) -> Iterator["WorkerPool"]:
    """The workers of the scheduler at `address`, as tcp://host:8786.

    They must find clips and outputs by the same paths. Start them with one thread each, `dask worker --nthreads 1`: a
    job has threads of its own.

    Raises `SchedulerLost` if no scheduler answers, ImportError if dask.distributed is not installed.
    """
    distributed = _import_distributed("scheduler")
    with _silence_dask(), _connect(distributed, address) as client:
        yield WorkerPool(client)


def _connect(distributed: Any, address: str) -> "Client":
    if not _ADDRESS.fullmatch(address):  # dask would retry for long, and leave a client behind
        expected, cure = "an address as tcp://host:8786", "`dask scheduler` prints it when it starts."
        raise invalid("scheduler", expected=expected, got=repr(address), cure=cure)
    try:
        return distributed.Client(address, set_as_default=False, timeout=CONNECT_SECONDS)
    except (OSError, TimeoutError, ValueError) as error:
        got = f"{address!r}, which does not answer ({one_line(error)})"
        cure = "Start one: dask scheduler; dask worker ADDRESS --nthreads 1."
        raise SchedulerLost(
            str(invalid("scheduler", expected="the address of a running scheduler", got=got, cure=cure))
        ) from error


def _import_distributed(what: str):
    try:
        import distributed
    except ImportError as error:
        raise ImportError(f"{what}: needs dask.distributed: pip install 'foldgauss[distributed]'.") from error
    return distributed


def run_on(
    pool: WorkerPool,
    jobs: Sequence[FitJob],
    on_progress: OnProgress,
    *,
    should_stop: Callable[[], bool] = lambda: False,
) -> Iterator[Outcome]:
    """Outcomes of the jobs in the order in which they end, run by the workers of the pool.

    Raises `Stopped` once `should_stop` returns True and the workers have written their checkpoints, `SchedulerLost`.
    """
    waiting = yield from _finished_outcomes(jobs)
    yield from _PoolRun(pool, waiting, on_progress, should_stop).outcomes()


class _PoolRun:
    """Jobs that run on a pool: `waiting`, `running` by key, and the keys of those that `ended`."""

    def __init__(
        self, pool: WorkerPool, jobs: Sequence[FitJob], on_progress: OnProgress, should_stop: Callable[[], bool]
    ):
        from distributed import Event

        self.pool, self.client, self.on_progress, self.should_stop = pool, pool.client, on_progress, should_stop
        self.topic = f"foldgauss-{secrets.token_hex(6)}"
        self.stop = Event(self.topic, client=pool.client)
        self.events: queue.SimpleQueue = queue.SimpleQueue()
        self.waiting, self.ended = deque(jobs), queue.SimpleQueue()
        self.running: dict[str, tuple[Any, FitJob]] = {}
        self.rounds: dict[str, tuple[int, Any]] = {}  # by target: fruitless rounds, and the checkpoint's stamp
        self.seen, self.warned = time.monotonic(), False  # when there were workers; that there are none

    def outcomes(self) -> Iterator[Outcome]:
        # Events arrive on the client's own thread; `on_progress` is called on this one.
        self.client.subscribe_topic(self.topic, lambda event: self.events.put(event[1]))
        try:
            while self.waiting or self.running:
                self._submit_waiting()
                yield from self._collect()
        finally:
            self._disconnect()

    def _submit_waiting(self) -> None:
        """Submit as many jobs as there are threads, no more: dask blames all jobs of a worker that dies."""
        threads = self.pool.threads
        self.pool.restart_missing(threads)
        if threads:
            self.seen = time.monotonic()
        elif time.monotonic() - self.seen > NO_WORKERS_SECONDS:
            cure = "start some, and run the command again" if self.pool.is_remote else _NONE_HERE
            raise SchedulerLost(f"No worker for {NO_WORKERS_SECONDS:g} s. Finished jobs are kept: {cure}.")
        elif self.pool.is_remote and not self.warned and time.monotonic() - self.seen > WARN_SECONDS:
            self.warned = True
            warnings.warn("No workers yet. Start some: dask worker ADDRESS --nthreads 1.", stacklevel=2)
        while self.waiting and len(self.running) < threads:
            self._submit(self.waiting.popleft())

    def _submit(self, job: FitJob) -> None:
        key = f"{self.topic}-{secrets.token_hex(6)}"
        future = self.client.submit(_run_on_worker, job, self.topic, key=key, pure=False)
        self.running[key] = (future, job)
        future.add_done_callback(lambda done: self.ended.put(done.key))

    def _collect(self) -> Iterator[Outcome]:
        """Pass on progress, and yield the outcome of a job that ends within a moment."""
        try:
            key = self.ended.get(timeout=_POLL_SECONDS)
        except queue.Empty:
            key = None
        while not self.events.empty():
            self.on_progress(Progress(*self.events.get()))
        if key in self.running:
            outcome = self._outcome(*self.running.pop(key))
            if outcome is not None:
                yield outcome
        if self.should_stop():
            self._stop_workers()

    def _outcome(self, future: Any, job: FitJob) -> Outcome | None:
        """The outcome of a job that has ended; None if it will run again."""
        from distributed import CancelledError, KilledWorker

        if future.status == "cancelled":
            raise SchedulerLost(_LOST)
        try:
            record, failure = future.result()
        except KilledWorker:
            return self._retry(job)
        except CancelledError as error:
            raise SchedulerLost(_LOST) from error
        except Stopped:
            raise
        except Exception as error:  # of the worker, as where foldgauss is missing or of another version there
            return Outcome(job, failure=one_line(error))
        return Outcome(job, record, failure)

    def _retry(self, job: FitJob) -> Outcome | None:
        """Queue a job whose workers died again, or give it up if its checkpoint makes no progress."""
        fruitless, before = self.rounds.get(job.target, (0, None))
        now = _stamp(job)
        fruitless = fruitless + 1 if now == before else 0
        if fruitless >= ROUNDS:
            return Outcome(
                job,
                failure=f"{job.name}: its workers died repeatedly without progress. "
                "Memory is probably short: use fewer workers, shorter segments or smaller frames.",
            )
        self.rounds[job.target] = (fruitless, now)
        self.waiting.appendleft(job)
        return None

    def _stop_workers(self) -> None:
        """Ask the workers to write their checkpoints, and wait for that."""
        self.stop.set()
        until = time.monotonic() + GRACE_SECONDS
        while time.monotonic() < until and not all(future.done() for future, _ in self.running.values()):
            time.sleep(_POLL_SECONDS)
        raise Stopped("stopped")

    def _disconnect(self) -> None:
        try:
            self.client.unsubscribe_topic(self.topic)
            self.client.cancel([future for future, _ in self.running.values()])
        except Exception:  # the scheduler is gone
            return


_NONE_HERE = (
    "they die while they start, for the reason above; a program of your own must start them under "
    '`if __name__ == "__main__":`'
)
_LOST = "The scheduler does not answer any more. Finished jobs are kept: start one, and run the command again."


def _stamp(job: FitJob) -> tuple[int, int] | None:
    """Time and size of a job's checkpoint, which change as it makes progress."""
    try:
        stat = os.stat(job.checkpoint)
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


def _run_on_worker(job: FitJob, topic: str) -> tuple[dict[str, Any] | None, str | None]:
    """Runs on a worker: the record of a job, or its failure."""
    from distributed import Event, get_worker

    worker = get_worker()
    stop = Event(topic)

    def report(progress: Progress) -> bool:
        worker.log_event(topic, tuple(progress))
        return not stop.is_set()

    outcome = _run_job(job, report)
    return outcome.record, outcome.failure
