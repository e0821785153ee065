"""Log-density and samples at a million points, beside numpyro's multivariate normal; folds on top; errors of float32.

    python -m benchmarks.distribution [--points N] [--rounds N] [--json FILE]

d = 3, f = 0 and a = 1 is the case that both can do; numpyro is measured where it is installed. Every ratio compares
two medians of alternating runs in one process. The table of first calls includes compilation: wall seconds, processor
seconds, and memory maps where /proc lists them. Errors of float32 are the largest differences to float64 of
log-densities and of the gradient of their sum by every parameter (degree 3, envelope of power 1), relative to
1 + |value|; `benchmarks.numerics` has those at the extremes.
"""

import importlib.util
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.fold import FourierFold, PolynomialFold, SplineFold

TRIL = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.3]], np.float32)  # time last
LOC = np.array([0.1, -0.4, 0.5], np.float32)
DEGREES = (1, 3, 7)


def _ours(fold=None, envelope=None) -> FoldedGaussian:
    time = {"time_loc": LOC[2], "time_scale": TRIL[2, 2]}
    return FoldedGaussian(LOC[:2], TRIL[:2, :2], **time, fold=fold, envelope=envelope or Constant())


def _distributions() -> dict[str, FoldedGaussian]:
    """The plain Gaussian, then one thing on top at a time."""
    rng = np.random.default_rng(_common.SEED)
    rows = lambda n: rng.normal(size=(n, 2)).astype(np.float32) * 0.1  # noqa: E731
    return {
        "foldgauss": _ours(),
        **{f"degree {k}": _ours(PolynomialFold(rows(k))) for k in DEGREES},
        "spline": _ours(SplineFold([-1, -1, -1, -1, 0, 1, 1, 1, 1], rows(5))),
        "fourier": _ours(FourierFold(rows(2), rows(2), period=1.0)),
        "envelope": _ours(envelope=TimeLikelihood()),
        "envelope, floor": _ours(envelope=TimeLikelihood(floor=0.01)),
        "degree 3, envelope": _ours(PolynomialFold(rows(3)), TimeLikelihood()),
    }


def _tasks(points: int) -> dict[str, _common.Task]:
    key = jax.random.key(_common.SEED)
    x = jax.block_until_ready(_ours().sample(key, (points,)))
    tasks = {}
    for name, dist in _distributions().items():
        log_prob = jax.jit(lambda dist, x: dist.log_prob(x))
        sample = jax.jit(lambda dist, key: dist.sample(key, (points,)))
        tasks[f"log_prob: {name}"] = _common.Task(lambda f=log_prob, d=dist: jax.block_until_ready(f(d, x)))
        tasks[f"sample: {name}"] = _common.Task(lambda f=sample, d=dist: jax.block_until_ready(f(d, key)))
    grad = jax.jit(jax.grad(lambda dist, x: dist.log_prob(x).sum()))
    last = _distributions()["degree 3, envelope"]
    tasks["gradient: degree 3, envelope"] = _common.Task(lambda: jax.block_until_ready(grad(last, x)))
    if importlib.util.find_spec("numpyro"):
        from numpyro.distributions import MultivariateNormal

        peer = MultivariateNormal(LOC, scale_tril=TRIL)
        log_prob, sample = jax.jit(peer.log_prob), jax.jit(lambda key: peer.sample(key, (points,)))
        np.testing.assert_allclose(log_prob(x), _ours().log_prob(x), rtol=1e-4, atol=1e-4)  # the same density
        tasks["log_prob: numpyro"] = _common.Task(lambda: jax.block_until_ready(log_prob(x)))
        tasks["sample: numpyro"] = _common.Task(lambda: jax.block_until_ready(sample(key)))
    read = jax.jit(lambda x: x[:, 0] + x[:, 1] * x[:, 2])  # what reading x and writing one number a point costs
    tasks["memory floor"] = _common.Task(lambda: jax.block_until_ready(read(x)))
    return tasks


def _first_calls() -> dict[str, float]:
    """Figures of eager first calls at 1,000 points, and of integrals over time for a second number of points."""
    dist, x = _distributions()["degree 3, envelope"], np.random.default_rng(_common.SEED).normal(size=(1000, 3)) * 0.3
    x, key, space = x.astype(np.float32), jax.random.key(_common.SEED), dist.marginal((0, 1))
    calls = {
        "log_prob": lambda: dist.log_prob(x),
        "sample": lambda: dist.sample(key, (1000,)),
        "moments": dist.moments,
        "gradient of log_prob": lambda: jax.jit(jax.grad(lambda x: dist.log_prob(x).sum()))(x),
        "space log_prob": lambda: space.log_prob(x[:, :2]),
        "space log_prob, again": lambda: space.log_prob(x[:, :2]),
        "space log_prob, 900 points": lambda: space.log_prob(x[:900, :2]),
        "mean of time given space": lambda: dist.time_given_space(x[0, :2]).mean,
    }
    figures = {}
    for name, call in calls.items():
        maps, seconds, processor = _num_maps(), time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        figures[f"first {name} (s)"] = time.perf_counter() - seconds
        figures[f"first {name} (s of processor)"] = time.process_time() - processor
        figures[f"first {name} (memory maps)"] = _num_maps() - maps
    return figures


def _num_maps() -> int:
    maps = Path("/proc/self/maps")
    return maps.read_text().count("\n") if maps.exists() else 0


def _errors(points: int) -> dict[str, float]:
    """Largest errors of float32, relative to 1 + |value|."""
    rng, results = np.random.default_rng(_common.SEED), {}
    rows, x = 0.1 * rng.normal(size=(3, 2)), 0.4 * rng.normal(size=(points, 3)).astype(np.float32)
    narrow = _ours(PolynomialFold(rows.astype(np.float32)), TimeLikelihood(1.0))
    with jax.enable_x64(True):
        for dtype in (np.float32, np.float64):
            dist, y = jax.tree.map(lambda leaf, dtype=dtype: jnp.asarray(leaf, dtype), (narrow, x))
            gradients = jax.jit(jax.grad(lambda dist, y: dist.log_prob(y).sum()))(dist, y)
            results["log_prob", dtype] = np.asarray(dist.log_prob(y), np.float64)
            leaves = [np.ravel(leaf) for leaf in jax.tree.leaves(gradients)]
            results["gradient", dtype] = np.concatenate(leaves).astype(np.float64)
    errors = {}
    for what in ("log_prob", "gradient"):
        own, truth = results[what, np.float32], results[what, np.float64]
        errors[f"{what}: error of float32"] = (np.abs(own - truth) / (1 + np.abs(truth))).max()
    return errors


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--points", type=_common.whole, default=1_000_000)
    made.add_argument("--rounds", type=_common.whole, default=7)
    options = _common.parse(made, arguments)
    jnp.zeros(1).block_until_ready()
    figures = _first_calls()
    for name, seconds in _common.interleaved(_tasks(options.points), options.rounds).items():
        kind, median = name.partition(":")[0], float(np.median(seconds))
        figures[f"{name} (ms)"] = 1e3 * median
        if kind != name and "gradient" not in name:
            figures[f"{name}, relative to foldgauss"] = 1e3 * median / figures[f"{kind}: foldgauss (ms)"]
    _common.finish(options.json, figures | _errors(options.points), points=options.points)


if __name__ == "__main__":
    main()
