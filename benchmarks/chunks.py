"""EM over chunks beside EM on one array: time of a pass, peak memory, and how far the results are apart.

    python -m benchmarks.chunks [--rows N] [--components K] [--chunk-rows N ...] [--passes N] [--json FILE]

Each way runs in a process of its own, which makes its rows, d = 3 in float32, from the same seeds: all at once, or
one chunk after another in each pass. The time of a pass is the difference of two fits, of few and of more iterations,
divided by the iterations more: starts and compiling are in neither. What reading costs is in it: "making the chunks" is
the same chunks made and not fitted. Peak memory is above what the process held before the fit; for "in memory", where
the rows are there before, their bytes are added. Parameters are compared after the longer fit, relative to the
largest number of each kind.
"""

import dataclasses
import json
import os
import resource
import subprocess
import sys
import time
import warnings

import numpy as np

from benchmarks import _common
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

#: Rows that are made from one seed, so that every way has the same ones.
SEED_ROWS = 12_500
PARAMETERS = ("weights_", "locs_", "space_covariances_", "time_means_", "time_scales_", "fold_coefficients_")
FEW = 2


def _rows(first: int, last: int) -> np.ndarray:
    """Rows first to last (multiples of SEED_ROWS): three tracks in two dimensions of space."""
    parts = []
    for seed in range(first // SEED_ROWS, last // SEED_ROWS):
        rng = np.random.default_rng(seed)
        t, which = rng.normal(0.5, 0.25, SEED_ROWS), rng.integers(0, 3, SEED_ROWS)
        s = np.choose(which, [t, 1 - t, 0.5 + 3 * t - 9 * t**2 + 6 * t**3])
        space = np.stack([s, s**2], 1) + 0.03 * rng.normal(size=(SEED_ROWS, 2))
        parts.append(np.column_stack([space, t]).astype(np.float32))
    return np.concatenate(parts)


@dataclasses.dataclass
class _Chunks:
    """Chunks that are generated anew in each pass."""

    num: int
    size: int

    def __iter__(self):
        return (_rows(first, min(first + self.size, self.num)) for first in range(0, self.num, self.size))


def _data(way: str, num: int, chunk: int):
    if way == "in memory":
        return _rows(0, num)
    starts = range(0, num, chunk)
    if way == "dask array":
        import dask.array
        from dask import delayed

        made = [delayed(_rows)(first, min(first + chunk, num)) for first in starts]
        sizes = [(min(first + chunk, num) - first, 3) for first in starts]
        return dask.array.concatenate(
            [dask.array.from_delayed(one, size, np.float32) for one, size in zip(made, sizes, strict=True)]
        )
    return _Chunks(num, chunk)


def _peak() -> float:
    """MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _one(way: str, num: int, chunk: int, components: int, passes: int) -> dict:
    """What one process measures."""
    warnings.simplefilter("ignore")
    settings = {"degree": 3, "init_params": "kmeans", "random_state": 0, "tol": 0.0}
    data = _data(way, num, chunk)
    fitted = lambda steps: FoldedGaussianMixture(components, max_iter=steps, **settings)  # noqa: E731
    fitted(FEW).fit(_rows(0, SEED_ROWS))  # JAX and its libraries are up
    before, seconds = _peak(), []
    for steps in (FEW, FEW + passes):
        begun = time.perf_counter()
        model = fitted(steps).fit(data)
        seconds.append(time.perf_counter() - begun)
        if steps == FEW:  # compiled: once more
            begun = time.perf_counter()
            fitted(steps).fit(data)
            seconds[-1] = time.perf_counter() - begun
    peak = _peak() - before + (data.nbytes / 2**20 if way == "in memory" else 0)
    making = 0.0
    if isinstance(data, _Chunks):
        begun = time.perf_counter()
        for _ in data:
            pass
        making = time.perf_counter() - begun
    found = {name: np.asarray(getattr(model, name), np.float64).tolist() for name in PARAMETERS}
    return {"pass": (seconds[1] - seconds[0]) / passes, "making": making, "peak": peak, "parameters": found}


def _measured(*arguments) -> dict:
    command = [sys.executable, "-m", "benchmarks.chunks", "--one", json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    if done.returncode:
        raise RuntimeError(f"{arguments}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _apart(one: dict, other: dict) -> float:
    pairs = [(np.asarray(one[name]), np.asarray(other[name])) for name in PARAMETERS]
    return max(float(np.abs(a - b).max() / np.abs(a).max()) for a, b in pairs)


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--rows", type=_common.whole, default=2_000_000, help=f"taken to a multiple of {SEED_ROWS}")
    made.add_argument("--components", type=_common.whole, default=8)
    made.add_argument("--chunk-rows", type=_common.whole, nargs="+", default=[12_500, 100_000, 500_000])
    made.add_argument("--passes", type=_common.whole, default=5)
    made.add_argument("--one", help="for this script's own processes")
    options = _common.parse(made, arguments)
    if options.one:
        print(json.dumps(_one(*json.loads(options.one))))
        return
    num = -(-options.rows // SEED_ROWS) * SEED_ROWS
    ways = [("in memory", num)]
    for rows in options.chunk_rows:
        size = -(-rows // SEED_ROWS) * SEED_ROWS
        ways += [("iterable", size), ("dask array", size)]
    title = f"{num:,} rows ({12 * num / 2**20:.0f} MiB), {options.components} components of degree 3"
    columns = ("rows", "of a chunk", "pass (s)", "making the chunks (s)", "peak (MiB)", "parameters apart")
    shown, figures, whole = _common.table(title, *columns), {}, None
    for way, size in ways:
        found = _measured(way, num, size, options.components, options.passes)
        whole = whole or found
        apart = _apart(whole["parameters"], found["parameters"])
        making = f"{found['making']:.2f}" if found["making"] else ""
        shown.add_row(way, f"{size:,}", f"{found['pass']:.2f}", making, f"{found['peak']:.0f}", f"{apart:.1e}")
        name = way if way == "in memory" else f"{way} of {size}"
        figures |= {f"{name}: pass": found["pass"], f"{name}: peak": found["peak"], f"{name}: apart": apart}
    _common.console.print(shown)
    _common.finish(options.json, figures, _common.describe_machine(), rows=num, components=options.components)


if __name__ == "__main__":
    main()
