"""Density estimation on curved data: foldgauss beside scikit-learn's mixtures and kernels, and a normalising flow.

    python -m benchmarks.density [--data NAME ...] [--methods NAME ...] [--splits N] [--points N] [--json FILE]
                                 [--figure FILE]

Six made sets and three measured ones (`benchmarks._density_data`), each split at random into halves: points, or
whole blocks and years of time series. Every method selects its size from the training half alone
(`benchmarks._density_methods`). Shown are the mean log-density of the other half in nats per point with its standard
error over splits, the difference to the best method with that of the paired differences, free parameters (of kernels
the numbers stored), and CPU seconds of the fit with its selection, medians over splits. Compiled programs come from
JAX's cache where it has them. The splits share points: their standard errors say how far the split matters, not how
far another sample would.

A fit that raises, or whose mean held-out log-density is not finite, has failed: it is counted, and left out of the
means. The measured sets and the flow need `pip install -e ".[bench]"`. With --json each finished fit is kept, and the
same command goes on after it. --figure draws the fits of the first split.
"""

import statistics
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import _common
from benchmarks._common import console
from benchmarks._density_data import DATA, POINTS, split
from benchmarks._density_methods import METHODS, OURS, Effort
from benchmarks._runs import Run, Runs

#: Random halves of each set.
SPLITS = 10
#: What is said of each set, beside the methods near the best.
VERDICTS = "ours_near_the_best", "ours_at_the_fewest_parameters"


class Row(NamedTuple):
    """A method on a data set, over the splits in which it did not fail."""

    data: str
    method: str
    mean: float
    error: float
    below: float  # the mean difference to the best method, and its standard error
    below_error: float
    parameters: float
    seconds: float
    failed: int
    splits: int


def _fit(data: str, method: str, seed: int, points: int, effort: Effort) -> Run:
    """One fit and its score; a failure is a result."""
    train, test = split(DATA[data](points), seed)
    begun = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of runs that stop at max_iter: `converged` says so
            fitted = METHODS[method](train, seed, effort)
        seconds = time.process_time() - begun
        held_out = float(np.mean(fitted.log_density(test)))
        of_train = float(np.mean(fitted.log_density(train)))
    except (ValueError, RuntimeError, FloatingPointError, np.linalg.LinAlgError) as error:
        return {"failed": f"{type(error).__name__}: {error}"[:300], "cpu_seconds": time.process_time() - begun}
    run: Run = {"parameters": fitted.parameters, "cpu_seconds": seconds, "converged": bool(fitted.converged)}
    run |= {"chosen": fitted.chosen, "rows": len(train)}
    if not np.isfinite(held_out):
        return run | {"failed": f"held-out log-density {held_out}"}
    return run | {"held_out": held_out, "train": of_train}


def _name(data: str, method: str, seed: int) -> str:
    return f"{data}: {method}, split {seed}"


def summarize(runs: dict[str, Run], data: str, methods: list[str], splits: int) -> list[Row]:
    """Rows of one data set, best first; methods without a finished fit are left out."""
    found: dict[str, dict[int, Run]] = {}
    for method in methods:
        own = {seed: runs[name] for seed in range(splits) if (name := _name(data, method, seed)) in runs}
        if own:
            found[method] = own
    scores = {
        method: {seed: run["held_out"] for seed, run in own.items() if "failed" not in run}
        for method, own in found.items()
    }
    # The best method is among those that never failed, if there are any.
    whole = {method: of for method, of in scores.items() if len(of) == len(found[method])} or scores
    ranked = {method: statistics.fmean(of.values()) for method, of in whole.items() if of}
    of_best = scores[max(ranked, key=lambda method: ranked[method])] if ranked else {}
    rows = []
    for method, own in found.items():
        values = scores[method]
        paired = [value - of_best[seed] for seed, value in values.items() if seed in of_best]
        rows.append(
            Row(
                data,
                method,
                *_mean_and_error(list(values.values())),
                *_mean_and_error(paired),
                statistics.median(run.get("parameters", np.nan) for run in own.values()),
                statistics.median(run["cpu_seconds"] for run in own.values()),
                len(own) - len(values),
                len(own),
            )
        )
    return sorted(rows, key=lambda row: -row.mean if np.isfinite(row.mean) else np.inf)


def _mean_and_error(values: list[float]) -> tuple[float, float]:
    if not values:
        return float("nan"), float("nan")
    error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return statistics.fmean(values), error


def judge(rows: list[Row]) -> dict[str, Any]:
    """Whether ours is best or within one standard error of it, and whether no other that is has fewer parameters."""
    near = [row for row in rows if row.below >= -row.below_error and row.failed == 0]
    ours = next((row for row in near if row.method == OURS), None)
    smallest = min((row.parameters for row in near if not row.method.startswith(OURS)), default=np.inf)
    return {
        "near_the_best": [row.method for row in near],
        "ours_near_the_best": ours is not None,
        "ours_at_the_fewest_parameters": ours is not None and ours.parameters <= smallest,
    }


def _show(rows: list[Row]) -> None:
    columns = ("method", "held out (nats/point)", "below the best", "parameters", "CPU (s)", "failed")
    cells = (
        (
            row.method,
            f"{row.mean:.3f} ± {row.error:.3f}",
            f"{row.below:+.3f} ± {row.below_error:.3f}",
            f"{row.parameters:,.0f}",
            f"{row.seconds:.1f}",
            f"{row.failed} of {row.splits}",
        )
        for row in rows
    )
    _common.print_table(rows[0].data, columns, cells)


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--data", nargs="+", choices=list(DATA), default=list(DATA), metavar="NAME")
    made.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    made.add_argument("--splits", type=_common.whole, default=SPLITS)
    made.add_argument("--points", type=_common.whole, default=POINTS, help="of a set, half of them held out")
    made.add_argument("--components", type=_common.whole, default=Effort().components, help="at most, of mixtures")
    made.add_argument("--starts", type=_common.whole, default=Effort().starts, help="of Gaussian mixtures")
    made.add_argument("--epochs", type=_common.whole, default=Effort().epochs, help="at most, of the flow")
    made.add_argument("--figure", type=Path, metavar="FILE", help="draw the first split's densities")
    options = _common.parse(made, arguments)
    effort = Effort(components=options.components, starts=options.starts, epochs=options.epochs)
    runs = Runs(options.json, {"points": options.points, **effort._asdict()})
    for seed in range(options.splits):  # splits outermost: a run that is stopped has compared all methods
        for method in options.methods:
            for data in options.data:
                runs.get(
                    _name(data, method, seed),
                    lambda data=data, method=method, seed=seed: _fit(data, method, seed, options.points, effort),
                )
        jax.clear_caches()  # of all splits together they have more memory maps than Linux grants (65,530)
    tables = {data: summarize(runs.done, data, options.methods, options.splits) for data in options.data}
    for rows in tables.values():
        _show(rows)
    judged = {data: judge(rows) for data, rows in tables.items()}
    for data, verdict in judged.items():
        console.print(f"{data}: best or within one standard error of it: {', '.join(verdict['near_the_best'])}")
    figures = {f"sets, {kind}": sum(verdict[kind] for verdict in judged.values()) for kind in VERDICTS}
    runs.finish(figures, table=[row._asdict() for rows in tables.values() for row in rows], judged=judged)
    if options.figure is not None:
        from benchmarks import _density_figure  # needs matplotlib

        _density_figure.draw(options.figure, tables, options.points, effort)


if __name__ == "__main__":
    main()
