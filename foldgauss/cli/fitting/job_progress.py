"""Runs jobs and displays their progress: a bar, lines in a log, or JSON."""

from collections.abc import Callable, Sequence
from typing import Any

from foldgauss.cli.app.application import Stopped, err
from foldgauss.cli.app.signals import note_signals
from foldgauss.cli.shared.console import Display, print_figures, show_progress
from foldgauss.cli.shared.fit_progress import print_json
from foldgauss.io.history import info_line
from foldgauss.jobs import FitJob, Outcome, run_here, run_on
from foldgauss.jobs import Stopped as JobsStopped
from foldgauss.video import Evaluation, FitConfig, FitInfo

#: Up to so many jobs, each has a line in a log.
MAX_LINES = 20


def describe_continuation(overwrite: bool) -> str:
    """How to continue a command that was stopped."""
    return f"Give the {'command again without --overwrite' if overwrite else 'same command again'} to continue."


def summarize_fit(scores: Evaluation, records: Sequence[dict[str, Any]], config: FitConfig) -> dict[str, Any]:
    """The figures of a fit as results show them, from the records of its parts."""
    height, width = records[0]["size"]
    return {
        "mean_psnr": round(scores.mean_psnr, 3),
        "mean_ssim": round(scores.mean_ssim, 4),
        "lowest_psnr": round(min(scores.psnr), 3),
        "num_frames": len(scores.psnr),
        "height": height,
        "width": width,
        "num_gaussians": sum(record["num_gaussians"] for record in records),
        "degree": config.fold_degree,
        "fit_seconds": round(sum(record["seconds"] for record in records), 2),
    }


def report_fit(display: Display, target: str, figures: dict[str, Any]) -> None:
    """Print the results of a fit, the model `target`."""
    if display == "json":
        print_json("done", {"model": target} | figures)
    elif display != "quiet":
        print_figures(target, figures)


def run_jobs(
    jobs: Sequence[FitJob],
    noun: str,
    display: Display,
    client: Any,
    *,
    overwrite: bool,
    on_end: Callable[[dict[str, Outcome]], None] = lambda ended: None,
) -> list[Outcome]:
    """Run the jobs, by the workers of a dask client or here, and display progress; outcomes in the order of the jobs.

    After Ctrl-C or SIGTERM, and once checkpoints are written, raises `Stopped`, whose message says how to continue.
    `on_end` receives the outcomes so far, by target.
    """
    ended: dict[str, Outcome] = {}
    with note_signals() as request, show_progress(display) as show:
        view = _View(noun, len(jobs), display, show)
        request.stepping = True  # jobs may stop at any moment

        def should_stop() -> bool:
            return bool(request.signal)

        if client is None:
            outcomes = run_here(jobs, view.update, should_stop=should_stop)
        else:
            outcomes = run_on(client, jobs, view.update, should_stop=should_stop)
        try:
            for outcome in outcomes:
                ended[outcome.job.target] = outcome
                view.end(outcome)
                on_end(ended)
        except JobsStopped as error:
            done = sum(outcome.failure is None for outcome in ended.values())
            text = f"stopped by {request.signal or 'the worker'}; {done} of {len(jobs)} {noun} are done"
            hint = describe_continuation(overwrite)
            raise Stopped(f"{text}, the others have checkpoints. {hint}") from error
    return [ended[job.target] for job in jobs]


class _View:
    """The state of the jobs, displayed as `display` says."""

    def __init__(self, noun: str, total: int, display: Display, show: Callable[..., None]):
        self.noun, self.total, self.display, self.show, self.done, self.failed = noun, total, display, show, 0, 0
        self.running: dict[str, FitInfo] = {}

    def update(self, name: str, info: FitInfo) -> None:
        self.running[name] = info
        if self.display == "json":
            print_json("progress", {"name": name} | info_line(info))
        self._show()

    def end(self, outcome: Outcome) -> None:
        name = outcome.job.name
        self.running.pop(name, None)
        self.done += outcome.failure is None
        self.failed += outcome.failure is not None
        if self.display == "json" and outcome.failure is not None:
            print_json("failed", {"name": name, "reason": outcome.failure})
        elif self.display == "json":
            figures = {name: outcome.record[name] for name in ("mean_psnr", "mean_ssim", "seconds", "steps")}
            print_json("ended", {"name": name} | figures)
        elif self.display == "lines" and self.total <= MAX_LINES:
            result = "failed" if outcome.failure is not None else f"{outcome.record['mean_psnr']:.2f} dB"
            err.print(f"{self._counts()}: {name}, {result}", soft_wrap=True)
        self._show()

    def _show(self) -> None:
        """The counts, and the jobs that run."""
        completed = self.done + self.failed + sum(info.progress for info in self.running.values())
        running = (f"{name} {info.progress:.0%} ({info.psnr:.1f} dB)" for name, info in self.running.items())
        text = "; ".join([self._counts(), *([", ".join(running)] if self.running else [])])
        self.show("Fitting", completed, self.total, text)

    def _counts(self) -> str:
        return f"{self.done} of {self.total} {self.noun} done" + (f", {self.failed} failed" if self.failed else "")
