"""Who does the jobs: this process, or the workers of dask.distributed, here or on a cluster.

Nothing of a job is lost with who does it: see `fitting`. dask replaces workers that die and gives their jobs to others;
what is here gives a job up that kills whoever takes it.
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
from foldgauss.jobs.fitting import FitJob, Progress, Stopped, finished, fit_job

if TYPE_CHECKING:
    from distributed import Client

#: dask gives a job back once so many of its workers have died, and it is given up after so many such rounds without a
#: new checkpoint.
DEATHS, ROUNDS = 3, 3
#: Seconds that workers have to keep what they do, once they are asked to stop.
GRACE = 60.0
#: What dask takes for an address.
_ADDRESS = re.compile(r"((tcp|tls|ucx|ucxx|ws|wss)://)?[^/\s]+:[0-9]{1,5}/?")
#: Seconds after which it is said that a cluster has no workers.
TOLD_SECONDS = 10.0
#: Seconds that a scheduler has to answer.
CONNECT_SECONDS = 10.0
#: Seconds that a cluster may be without workers.
NO_WORKERS = 120.0
#: Seconds that workers of this machine may be missing before others are started; twice as long each time.
MEND_SECONDS = 20.0
_POLL = 0.2


class SchedulerLost(OSError):
    """The scheduler is gone; what is done is kept."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a job: its record, or why there is none, in one line."""

    job: FitJob
    record: dict[str, Any] | None = None
    failure: str | None = None


Watch = Callable[[Progress], None]


def run_here(
    jobs: Sequence[FitJob], watch: Watch, *, asked_to_stop: Callable[[], bool] = lambda: False
) -> Iterator[Outcome]:
    """Outcomes of the jobs, one after another, done by this process.

    Raises `Stopped` at a job that stops, since `asked_to_stop` says so; it is kept.
    """
    waiting = yield from _done_before(jobs)
    for job in waiting:

        def tell(progress: Progress) -> bool:
            watch(progress)
            return not asked_to_stop()

        if asked_to_stop():
            raise Stopped("stopped between two jobs")
        yield _tried(job, tell)


def _done_before(jobs: Sequence[FitJob]) -> Generator[Outcome, None, list[FitJob]]:
    """Outcomes of jobs that somebody has done; returns the others."""
    waiting = []
    for job in jobs:
        record = finished(job)
        if record is None:
            waiting.append(job)
        else:
            yield Outcome(job, record)
    return waiting


def _tried(job: FitJob, tell: Callable[[Progress], bool]) -> Outcome:
    """The outcome of a job done here; what is wrong with its clip or its disk is one."""
    try:
        return Outcome(job, fit_job(job, tell))
    except Stopped:
        raise
    except Exception as error:  # any: the others go on
        return Outcome(job, failure=one_line(error))


def one_line(error: BaseException) -> str:
    text = " ".join(str(error).split())
    plain = isinstance(error, ValueError | OSError) and text
    return text if plain else f"{type(error).__name__}: {text}"[:300]


class WorkerPool:
    """Workers of dask.distributed, as `local_workers` and `running_cluster` give them."""

    def __init__(self, client: "Client", cluster: Any = None, count: int = 0):
        self.client, self._cluster, self._count = client, cluster, count
        self._since, self._patience = time.monotonic(), MEND_SECONDS

    @property
    def is_remote(self) -> bool:
        """Whether others start its workers."""
        return self._cluster is None

    @property
    def threads(self) -> int:
        """Jobs that can be done at once, now. Raises `SchedulerLost`."""
        try:
            if self.client.status not in ("running", "connecting"):
                raise SchedulerLost(_LOST)
            return sum(self.client.nthreads().values())
        except (OSError, TimeoutError) as error:
            raise SchedulerLost(_LOST) from error

    def mend(self, alive: int) -> None:
        """Bring workers of this machine in place of those that stay away.

        Who dies at work is replaced by dask; who dies while it starts, is not.
        """
        now = time.monotonic()
        if alive >= self._count:
            self._since, self._patience = now, MEND_SECONDS
        elif now - self._since > self._patience:
            self._since, self._patience = now, 2 * self._patience  # starting takes long on a busy machine
            self._cluster.scale(alive)  # those that are not there are the first to be given up
            self._cluster.scale(self._count)


@contextmanager
def _silenced() -> Iterator[None]:
    """dask tells of each worker that dies, with its traceback; who does the jobs is told by their outcomes."""
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
    """A crew of `count` processes of this machine, each with `threads` of its cores (default: an equal share).

    Workers end with this process, however it ends, and are replaced when they die. They import the program that starts
    them: in a file of your own, do so under `if __name__ == "__main__":`, or none comes to work.

    Raises ValueError for counts that are none, ImportError where dask.distributed is not installed.
    """
    for name, value in (("workers", count), ("threads", 1 if threads is None else threads)):
        if not is_integer(value, 1):
            raise invalid(name, expected="a whole number >= 1", got=repr(value))
    distributed = _distributed("workers")
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
    with ExitStack() as stack, _silenced():
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="foldgauss-", ignore_cleanup_errors=True))
        stack.enter_context(dask.config.set(settings))
        cluster = distributed.LocalCluster(
            n_workers=0,  # for `WorkerPool.mend` to bring: one that dies while it starts is no reason to fail
            threads_per_worker=1,
            processes=True,
            memory_limit=None,  # a worker that is stopped for its memory would be stopped again
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # a port of its own: two commands may run at once
            local_directory=scratch,
            silence_logs=50,
            env=environment,
            preload=["foldgauss._runtime.worker"],
        )
        stack.enter_context(cluster)
        cluster.loop.add_callback(_block_ctrl_c)
        crew = WorkerPool(stack.enter_context(distributed.Client(cluster, set_as_default=False)), cluster, count)
        cluster.scale(count)
        yield crew


def _block_ctrl_c() -> None:
    """On the thread that starts workers, and so in these from the first moment: a terminal sends it to them, too."""
    if hasattr(signal, "pthread_sigmask"):  # not Windows
        resource_tracker.ensure_running()  # or starting it, with the first worker, would take the block away
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


@contextmanager
def running_cluster(address: str) -> Iterator["WorkerPool"]:
    """The crew of the scheduler at `address`, as tcp://host:8786. Its workers must find clips and outputs by the same
    paths, and are best started with one thread each, `dask worker --nthreads 1`, as a job has threads of its own.

    Raises `SchedulerLost` where none answers, ImportError where dask.distributed is not installed.
    """
    distributed = _distributed("scheduler")
    with _silenced(), _client(distributed, address) as client:
        yield WorkerPool(client)


def _client(distributed: Any, address: str) -> "Client":
    if not _ADDRESS.fullmatch(address):  # dask would take its time, and leave half a client
        expected, cure = "an address as tcp://host:8786", "It is what `dask scheduler` says when it starts."
        raise invalid("scheduler", expected=expected, got=repr(address), cure=cure)
    try:
        return distributed.Client(address, set_as_default=False, timeout=CONNECT_SECONDS)
    except (OSError, TimeoutError, ValueError) as error:
        got = f"{address!r}, where none answers ({one_line(error)})"
        cure = "Start one: dask scheduler; dask worker ADDRESS --nthreads 1."
        raise SchedulerLost(
            str(invalid("scheduler", expected="the address of a running one", got=got, cure=cure))
        ) from error


def _distributed(what: str):
    try:
        import distributed
    except ImportError as error:
        raise ImportError(f"{what}: needs dask.distributed: pip install 'foldgauss[distributed]'.") from error
    return distributed


def run_on(
    crew: WorkerPool, jobs: Sequence[FitJob], watch: Watch, *, asked_to_stop: Callable[[], bool] = lambda: False
) -> Iterator[Outcome]:
    """Outcomes of the jobs in the order in which they end, done by the workers of `crew`.

    Raises `Stopped` once `asked_to_stop` says so and the workers have kept what they do, `SchedulerLost`.
    """
    waiting = yield from _done_before(jobs)
    yield from _Run(crew, waiting, watch, asked_to_stop).outcomes()


class _Run:
    """Jobs on their way."""

    def __init__(self, crew: WorkerPool, jobs: Sequence[FitJob], watch: Watch, asked_to_stop: Callable[[], bool]):
        from distributed import Event

        self.crew, self.client, self.watch, self.asked_to_stop = crew, crew.client, watch, asked_to_stop
        self.topic = f"foldgauss-{secrets.token_hex(6)}"
        self.stop = Event(self.topic, client=crew.client)
        self.told: queue.SimpleQueue = queue.SimpleQueue()
        self.waiting, self.ended = deque(jobs), queue.SimpleQueue()
        self.open: dict[str, tuple[Any, FitJob]] = {}
        self.rounds: dict[str, tuple[int, Any]] = {}  # in which a job's workers died
        self.seen, self.told_lonely = time.monotonic(), False  # workers; that there are none

    def outcomes(self) -> Iterator[Outcome]:
        # Events come on the client's own thread, and go to `watch` on this one.
        self.client.subscribe_topic(self.topic, lambda event: self.told.put(event[1]))
        try:
            while self.waiting or self.open:
                self._fill()
                yield from self._some()
        finally:
            self._leave()

    def _fill(self) -> None:
        """Give out as many jobs as there are threads, and no more: dask blames each that a worker had when it died."""
        threads = self.crew.threads
        self.crew.mend(threads)
        if threads:
            self.seen = time.monotonic()
        elif time.monotonic() - self.seen > NO_WORKERS:
            told = "start some, and give the command again" if self.crew.is_remote else _NONE_HERE
            raise SchedulerLost(f"No worker came for {NO_WORKERS:g} s. What is finished is kept: {told}.")
        elif self.crew.is_remote and not self.told_lonely and time.monotonic() - self.seen > TOLD_SECONDS:
            self.told_lonely = True
            warnings.warn("No worker has come yet. Start some: dask worker ADDRESS --nthreads 1.", stacklevel=2)
        while self.waiting and len(self.open) < threads:
            self._submit(self.waiting.popleft())

    def _submit(self, job: FitJob) -> None:
        key = f"{self.topic}-{secrets.token_hex(6)}"
        future = self.client.submit(_work, job, self.topic, key=key, pure=False)
        self.open[key] = (future, job)
        future.add_done_callback(lambda done: self.ended.put(done.key))

    def _some(self) -> Iterator[Outcome]:
        """What has come within a moment."""
        try:
            key = self.ended.get(timeout=_POLL)
        except queue.Empty:
            key = None
        while not self.told.empty():
            self.watch(Progress(*self.told.get()))
        if key in self.open:
            outcome = self._outcome(*self.open.pop(key))
            if outcome is not None:
                yield outcome
        if self.asked_to_stop():
            self._stop()

    def _outcome(self, future: Any, job: FitJob) -> Outcome | None:
        """Of a job that has ended; None of one that is given to another worker."""
        from distributed import CancelledError, KilledWorker

        if future.status == "cancelled":
            raise SchedulerLost(_LOST)
        try:
            record, failure = future.result()
        except KilledWorker:
            return self._again(job)
        except CancelledError as error:
            raise SchedulerLost(_LOST) from error
        except Stopped:
            raise
        except Exception as error:  # of the worker's own, as of a foldgauss that is none or another there
            return Outcome(job, failure=one_line(error))
        return Outcome(job, record, failure)

    def _again(self, job: FitJob) -> Outcome | None:
        """A job whose workers died: once more while it gets on."""
        fruitless, before = self.rounds.get(job.target, (0, None))
        now = _when(job)
        fruitless = fruitless + 1 if now == before else 0
        if fruitless >= ROUNDS:
            return Outcome(
                job,
                failure=f"{job.name}: its workers died again and again without getting on. "
                "Most likely memory is short: take fewer workers, shorter segments or smaller frames.",
            )
        self.rounds[job.target] = (fruitless, now)
        self.waiting.appendleft(job)
        return None

    def _stop(self) -> None:
        """Ask the workers to keep what they do, and wait for that."""
        self.stop.set()
        until = time.monotonic() + GRACE
        while time.monotonic() < until and not all(future.done() for future, _ in self.open.values()):
            time.sleep(_POLL)
        raise Stopped("stopped")

    def _leave(self) -> None:
        try:
            self.client.unsubscribe_topic(self.topic)
            self.client.cancel([future for future, _ in self.open.values()])
        except Exception:  # the scheduler is gone, and all this with it
            return


_NONE_HERE = (
    "they die while they start, of what is told above; a program of your own must start them under "
    '`if __name__ == "__main__":`'
)
_LOST = "The scheduler is gone. What is finished is kept: start one, and give the command again."


def _when(job: FitJob) -> tuple[int, int] | None:
    """What tells one checkpoint of a job from the next."""
    try:
        stat = os.stat(job.kept)
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size


def _work(job: FitJob, topic: str) -> tuple[dict[str, Any] | None, str | None]:
    """A worker's part: the record of a job, or its failure."""
    from distributed import Event, get_worker

    worker = get_worker()
    stop = Event(topic)

    def tell(progress: Progress) -> bool:
        worker.log_event(topic, tuple(progress))
        return not stop.is_set()

    outcome = _tried(job, tell)
    return outcome.record, outcome.failure
