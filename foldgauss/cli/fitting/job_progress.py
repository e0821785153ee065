"""Runs jobs and displays their progress: a bar, lines in a log, or JSON."""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from foldgauss.cli.app.application import Stopped, err
from foldgauss.cli.app.signals import note_signals
from foldgauss.cli.shared.fit_progress import Display, print_json
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
    view = _View(noun, len(jobs), display)
    with note_signals() as request, view.bar:
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
    """The state of the jobs, displayed as `display` says."""

    def __init__(self, noun: str, total: int, display: Display):
        self.noun, self.total, self.display, self.done, self.failed = noun, total, display, 0, 0
        self.running: dict[str, JobProgress] = {}
        self.due = time.monotonic() + FIRST_LINE_SECONDS
        description = TextColumn("{task.description}", markup=False)  # file names
        columns = description, BarColumn(bar_width=20), TimeElapsedColumn(), *TIME_LEFT
        self.bar = Progress(*columns, console=err, disable=display != "bar")
        self.task = self.bar.add_task(self._describe(), total=total)

    def update(self, progress: JobProgress) -> None:
        self.running[progress.name] = progress
        if self.display == "json":
            known = progress._asdict().items()
            emit_json("progress", {name: value for name, value in known if value == value and value != math.inf})
        elif self.display == "lines" and time.monotonic() >= self.due:
            self.due = time.monotonic() + LINE_SECONDS
            err.print(self._describe(), soft_wrap=True)
        self._update_bar()

    def end(self, outcome: Outcome) -> None:
        name = outcome.job.name
        self.running.pop(name, None)
        self.done += outcome.failure is None
        self.failed += outcome.failure is not None
        if self.display == "json" and outcome.failure is not None:
            emit_json("failed", {"name": name, "reason": outcome.failure})
        elif self.display == "json":
            figures = {name: outcome.record[name] for name in ("mean_psnr", "mean_ssim", "seconds", "steps")}
            emit_json("ended", {"name": name} | figures)
        elif self.display == "lines" and self.total <= MAX_LINES:
            result = "failed" if outcome.failure is not None else f"{outcome.record['mean_psnr']:.2f} dB"
            err.print(f"{self._counts()}: {name}, {result}", soft_wrap=True)
        self._update_bar()

    def _update_bar(self) -> None:
        completed = self.done + self.failed + sum(job.fraction for job in self.running.values())
        self.bar.update(self.task, completed=completed, description=self._describe())

    def _counts(self) -> str:
        return f"{self.done} of {self.total} {self.noun} done" + (f", {self.failed} failed" if self.failed else "")

    def _describe(self) -> str:
        """The counts, and the jobs that run."""
        running = (f"{job.name} {job.fraction:.0%} ({job.psnr:.1f} dB)" for job in self.running.values())
        return "; ".join([self._counts(), *([", ".join(running)] if self.running else [])])
