"""Runs jobs and displays their progress: a bar for all and one per running job, lines in a log, or JSON."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from foldgauss.cli.app.application import Stopped, err
from foldgauss.cli.app.signals import note_signals
from foldgauss.cli.fitting.progress import Display, print_json
from foldgauss.cli.shared.log_lines import FIRST_LINE_SECONDS, LINE_SECONDS
from foldgauss.cli.shared.rendering import TIME_LEFT
from foldgauss.jobs import FitJob, Outcome, WorkerPool, run_here, run_on
from foldgauss.jobs import Progress as JobProgress
from foldgauss.jobs import Stopped as JobsStopped

#: Up to so many jobs, each has a line in a log.
MAX_LINES = 20


def emit_json(event: str, figures: dict[str, Any]) -> None:
    """Print a line of JSON; a closed standard output must not end the fits."""
    with suppress(OSError):
        print_json(event, figures)


def run_jobs(
    jobs: Sequence[FitJob],
    noun: str,
    display: Display,
    pool: WorkerPool | None,
    *,
    on_end: Callable[[Outcome], None] = lambda outcome: None,
    cure: str,
) -> list[Outcome]:
    """Run the jobs, by the workers of `pool` or here, and display progress; outcomes in the order of the jobs.

    After Ctrl-C or SIGTERM, and once checkpoints are written, raises `Stopped`, whose message ends with `cure`.
    """
    ended: dict[str, Outcome] = {}
    with note_signals() as request, _open_view(noun, len(jobs), display) as view:
        request.stepping = True  # jobs may stop at any moment

        def should_stop() -> bool:
            return bool(request.signal)

        if pool is None:
            outcomes = run_here(jobs, view.update, should_stop=should_stop)
        else:
            outcomes = run_on(pool, jobs, view.update, should_stop=should_stop)
        try:
            for outcome in outcomes:
                ended[outcome.job.target] = outcome
                view.end(outcome)
                on_end(outcome)
        except JobsStopped as error:
            done = sum(outcome.failure is None for outcome in ended.values())
            text = f"stopped by {request.signal or 'the worker'}; {done} of {len(jobs)} {noun} are done"
            raise Stopped(f"{text}, the others have checkpoints. {cure}") from error
    return [ended[job.target] for job in jobs]


class _View:
    """The state of the jobs; it displays nothing itself."""

    def __init__(self, noun: str, total: int):
        self.noun, self.total, self.done, self.failed = noun, total, 0, 0
        self.running: dict[str, JobProgress] = {}

    def update(self, progress: JobProgress) -> None:
        self.running[progress.name] = progress

    def end(self, outcome: Outcome) -> None:
        self.running.pop(outcome.job.name, None)
        self.done += outcome.failure is None
        self.failed += outcome.failure is not None

    @property
    def completed(self) -> float:
        return self.done + self.failed + sum(job.fraction for job in self.running.values())

    @property
    def counts(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{self.done} of {self.total} {self.noun} done{failed}"


def _describe(progress: JobProgress) -> str:
    psnr = f"{progress.psnr:.2f} dB" if math.isfinite(progress.psnr) else ""
    return f"{progress.step} steps  {psnr}  {progress.num_gaussians:,} Gaussians"


class _Bars(_View):
    """A bar for all jobs, and one for each that runs."""

    def __init__(self, noun: str, total: int, bars: Progress):
        super().__init__(noun, total)
        self.bars = bars
        self.all = bars.add_task(self.counts, total=total, text="")
        self.tasks: dict[str, TaskID] = {}

    def update(self, progress: JobProgress) -> None:
        super().update(progress)
        if progress.name not in self.tasks:
            self.tasks[progress.name] = self.bars.add_task(f"  {progress.name}", total=1.0, text="")
        self.bars.update(self.tasks[progress.name], completed=progress.fraction, text=_describe(progress))
        self._update_all()

    def end(self, outcome: Outcome) -> None:
        super().end(outcome)
        if outcome.job.name in self.tasks:
            self.bars.remove_task(self.tasks.pop(outcome.job.name))
        self._update_all()

    def _update_all(self) -> None:
        self.bars.update(self.all, description=self.counts, completed=self.completed)


class _Lines(_View):
    """A line now and then, and one for each job that ends if there are few."""

    def __init__(self, noun: str, total: int):
        super().__init__(noun, total)
        self.next = time.monotonic() + FIRST_LINE_SECONDS

    def update(self, progress: JobProgress) -> None:
        super().update(progress)
        if time.monotonic() >= self.next:
            self.next = time.monotonic() + LINE_SECONDS
            running = (f"{job.name} {job.fraction:.0%} ({job.psnr:.1f} dB)" for job in self.running.values())
            err.print(f"{self.counts}; {', '.join(running)}", soft_wrap=True)

    def end(self, outcome: Outcome) -> None:
        super().end(outcome)
        if self.total <= MAX_LINES:
            result = "failed" if outcome.failure is not None else f"{outcome.record['mean_psnr']:.2f} dB"
            err.print(f"{self.counts}: {outcome.job.name}, {result}", soft_wrap=True)


class _Json(_View):
    """Events as lines of JSON."""

    def update(self, progress: JobProgress) -> None:
        super().update(progress)
        finite = {name: value for name, value in progress._asdict().items() if value == value and value != math.inf}
        emit_json("progress", finite)

    def end(self, outcome: Outcome) -> None:
        super().end(outcome)
        if outcome.failure is not None:
            emit_json("failed", {"name": outcome.job.name, "reason": outcome.failure})
        else:
            figures = {name: outcome.record[name] for name in ("mean_psnr", "mean_ssim", "seconds", "steps")}
            emit_json("ended", {"name": outcome.job.name} | figures)


@contextmanager
def _open_view(noun: str, total: int, display: Display) -> Iterator[_View]:
    if display != "bar":
        kinds = {"lines": _Lines, "json": _Json, "quiet": _View}
        yield kinds[display](noun, total)
        return
    columns = (
        TextColumn("{task.description}", markup=False),  # file names
        BarColumn(bar_width=20),
        TimeElapsedColumn(),
        *TIME_LEFT,
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=err) as bars:
        yield _Bars(noun, total, bars)
