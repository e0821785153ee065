"""How many jobs at once are shown: one bar for all and one for each that runs, lines in a log, or JSON."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from importlib.util import find_spec
from typing import Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from foldgauss._runtime.threads import available_cores
from foldgauss.cli.app.application import Stopped, WrongUse, err
from foldgauss.cli.app.shared import TIME_LEFT
from foldgauss.cli.app.signals import noted_signals
from foldgauss.cli.fitting.progress import Manner, print_json
from foldgauss.jobs import FitJob, Outcome, WorkerPool, local_workers, run_here, run_on, running_cluster
from foldgauss.jobs import Progress as Share
from foldgauss.jobs import Stopped as JobsStopped

#: Seconds between two lines of a log; the first comes sooner, since something may be misspelt.
FIRST_LINE, LINE = 10.0, 30.0
#: Jobs of which each has a line in a log.
FEW = 20


def tell_json(event: str, figures: dict[str, Any]) -> None:
    """A line of JSON; that nobody listens any more is no reason to lose a fit."""
    with suppress(OSError):
        print_json(event, figures)


def run_jobs(
    jobs: Sequence[FitJob],
    what: str,
    manner: Manner,
    crew: WorkerPool | None,
    *,
    on_end: Callable[[Outcome], None] = lambda outcome: None,
    cure: str,
) -> list[Outcome]:
    """Have the jobs done, by `crew` or here, and show how far they are; outcomes in the order of the jobs.

    Ctrl-C and SIGTERM end them, once what is done is kept: raises `Stopped`, which says how to go on, by `cure`.
    """
    ended: dict[str, Outcome] = {}
    with noted_signals() as asked, _shown(what, len(jobs), manner) as view:
        asked.stepping = True  # what comes is kept at any moment
        how = {"asked_to_stop": lambda: bool(asked.name)}
        outcomes = run_here(jobs, view.watch, **how) if crew is None else run_on(crew, jobs, view.watch, **how)
        try:
            for outcome in outcomes:
                ended[outcome.job.target] = outcome
                view.ended(outcome)
                on_end(outcome)
        except JobsStopped as error:
            done = sum(outcome.failure is None for outcome in ended.values())
            told = f"stopped by {asked.name or 'the worker'}; {done} of {len(jobs)} {what} are done"
            raise Stopped(f"{told}, what was begun is kept. {cure}") from error
    return [ended[job.target] for job in jobs]


@dataclasses.dataclass(frozen=True)
class WorkerOptions:
    """Who is asked to do jobs: `workers` of this machine, each of so many `threads`, those of a `scheduler`, or nobody.

    Raises WrongUse for options that do not go together.
    """

    workers: int | None
    scheduler: str | None
    threads: int | None

    def __post_init__(self) -> None:
        if self.scheduler is not None and (self.workers is not None or self.threads is not None):
            other = "--workers" if self.workers is not None else "--threads"
            raise WrongUse(f"{other}: expected no --scheduler beside it, which has workers of its own. Leave one out.")
        if self.threads is not None and self.workers is None:
            raise WrongUse("--threads: expected --workers beside it. Of this process: FOLDGAUSS_NUM_THREADS.")
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
        each = f"{self.threads} thread{'' if self.threads == 1 else 's'}"
        return f"{self.workers} worker{'' if self.workers == 1 else 's'} of {each}"

    def crew(self) -> AbstractContextManager[WorkerPool | None]:
        if self.scheduler is not None:
            return running_cluster(self.scheduler)
        return nullcontext() if self.workers is None else local_workers(self.workers, threads=self.threads)


class _View:
    """What is told of jobs; by itself nothing."""

    def __init__(self, what: str, total: int):
        self.what, self.total, self.done, self.failed = what, total, 0, 0
        self.shares: dict[str, Share] = {}

    def watch(self, share: Share) -> None:
        self.shares[share.name] = share

    def ended(self, outcome: Outcome) -> None:
        self.shares.pop(outcome.job.name, None)
        self.done += outcome.failure is None
        self.failed += outcome.failure is not None

    @property
    def completed(self) -> float:
        return self.done + self.failed + sum(share.share for share in self.shares.values())

    @property
    def counts(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{self.done} of {self.total} {self.what} done{failed}"


def _told(share: Share) -> str:
    psnr = f"{share.psnr:.2f} dB" if math.isfinite(share.psnr) else ""
    return f"{share.step} steps  {psnr}  {share.num_gaussians:,} Gaussians"


class _Bars(_View):
    def __init__(self, what: str, total: int, progress: Progress):
        super().__init__(what, total)
        self.progress = progress
        self.all = progress.add_task(self.counts, total=total, told="")
        self.tasks: dict[str, TaskID] = {}

    def watch(self, share: Share) -> None:
        super().watch(share)
        if share.name not in self.tasks:
            self.tasks[share.name] = self.progress.add_task(f"  {share.name}", total=1.0, told="")
        self.progress.update(self.tasks[share.name], completed=share.share, told=_told(share))
        self._whole()

    def ended(self, outcome: Outcome) -> None:
        super().ended(outcome)
        if outcome.job.name in self.tasks:
            self.progress.remove_task(self.tasks.pop(outcome.job.name))
        self._whole()

    def _whole(self) -> None:
        self.progress.update(self.all, description=self.counts, completed=self.completed)


class _Lines(_View):
    """A line for each that ends, where these are few; else, and between, one now and then."""

    def __init__(self, what: str, total: int):
        super().__init__(what, total)
        self.next = time.monotonic() + FIRST_LINE

    def watch(self, share: Share) -> None:
        super().watch(share)
        if time.monotonic() >= self.next:
            self.next = time.monotonic() + LINE
            running = (f"{one.name} {one.share:.0%} ({one.psnr:.1f} dB)" for one in self.shares.values())
            err.print(f"{self.counts}; {', '.join(running)}", soft_wrap=True)

    def ended(self, outcome: Outcome) -> None:
        super().ended(outcome)
        if self.total <= FEW:
            what = "failed" if outcome.failure is not None else f"{outcome.record['mean_psnr']:.2f} dB"
            err.print(f"{self.counts}: {outcome.job.name}, {what}", soft_wrap=True)


class _Json(_View):
    def watch(self, share: Share) -> None:
        super().watch(share)
        finite = {name: value for name, value in share._asdict().items() if value == value and value != math.inf}
        tell_json("progress", finite)

    def ended(self, outcome: Outcome) -> None:
        super().ended(outcome)
        if outcome.failure is not None:
            tell_json("failed", {"name": outcome.job.name, "reason": outcome.failure})
        else:
            figures = {name: outcome.record[name] for name in ("mean_psnr", "mean_ssim", "seconds", "steps")}
            tell_json("ended", {"name": outcome.job.name} | figures)


@contextmanager
def _shown(what: str, total: int, manner: Manner) -> Iterator[_View]:
    if manner != "bar":
        kinds = {"lines": _Lines, "json": _Json, "quiet": _View}
        yield kinds[manner](what, total)
        return
    columns = (
        TextColumn("{task.description}", markup=False),  # names of files
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        *TIME_LEFT,
        TextColumn("{task.fields[told]}"),
    )
    with Progress(*columns, console=err) as progress:
        yield _Bars(what, total, progress)
