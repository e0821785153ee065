"""`WorkerOptions`: the options that choose which processes run jobs."""

import dataclasses
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec

from foldgauss._runtime.threads import available_cores
from foldgauss.cli.app.application import WrongUse
from foldgauss.cli.shared.tables import format_count
from foldgauss.jobs import WorkerPool, local_workers, running_cluster


@dataclasses.dataclass(frozen=True)
class WorkerOptions:
    """What runs jobs: `workers` of this machine with `threads` each, those of a `scheduler`, or this process.

    Raises WrongUse for options that exclude each other.
    """

    workers: int | None
    scheduler: str | None
    threads: int | None

    def __post_init__(self) -> None:
        if self.scheduler is not None and (self.workers is not None or self.threads is not None):
            other = "--workers" if self.workers is not None else "--threads"
            raise WrongUse(f"{other}: expected no --scheduler, which has workers of its own. Leave one out.")
        if self.threads is not None and self.workers is None:
            raise WrongUse("--threads: expected --workers too. For this process: FOLDGAUSS_NUM_THREADS.")
        if (self.workers is not None or self.scheduler is not None) and find_spec("distributed") is None:
            option = "--workers" if self.scheduler is None else "--scheduler"
            raise WrongUse(f"{option}: needs dask.distributed: pip install 'foldgauss[distributed]'.")
        if self.workers is not None and self.threads is None:
            object.__setattr__(self, "threads", max(1, available_cores() // self.workers))

    def __str__(self) -> str:
        if self.scheduler is not None:
            return f"the workers of {self.scheduler}"
        if self.workers is None:
            return "this process"
        return f"{format_count(self.workers, 'worker')} of {format_count(self.threads, 'thread')}"

    def open_pool(self) -> AbstractContextManager[WorkerPool | None]:
        """The workers; None for this process."""
        if self.scheduler is not None:
            return running_cluster(self.scheduler)
        return nullcontext() if self.workers is None else local_workers(self.workers, threads=self.threads)
