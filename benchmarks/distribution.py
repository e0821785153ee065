"""Log-density and samples at a million points, beside numpyro's and TFP's multivariate normal; folds on top.

    python -m benchmarks.distribution [--points N] [--rounds N] [--json FILE]

d = 3, f = 0 and a = 1 is the case all of them can do. Peers are measured where they import (`pip install numpyro`).
Every ratio is of two medians from the same run, in turn; ratios above 1 mean that foldgauss is faster. First calls are
those of this process, with their compilation: seconds, of the processor too, and memory maps where /proc shows them.
"""

import importlib.util
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common as common
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
    rng = np.random.default_rng(common.SEED)
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


def _peers() -> dict[str, object]:
    """name -> (distribution, its sample(key, shape))."""
    peers = {}
    if importlib.util.find_spec("numpyro"):
        import numpyro.distributions as numpyro

        peers["numpyro"] = numpyro.MultivariateNormal(LOC, scale_tril=TRIL)
    if importlib.util.find_spec("tensorflow_probability"):
        try:
            from tensorflow_probability.substrates import jax as tfp

            peers["tfp"] = tfp.distributions.MultivariateNormalTriL(LOC, TRIL)
        except Exception as error:  # it breaks with each new JAX; say so, and go on without it
            common.console.print(f"TFP does not import: {error!r}", style="yellow")
    return peers


def _tasks(points: int) -> dict[str, common.Task]:
    key = jax.random.key(common.SEED)
    x = jax.block_until_ready(_ours().sample(key, (points,)))
    tasks = {}
    for name, dist in _distributions().items():
        log_prob = jax.jit(lambda dist, x: dist.log_prob(x))
        sample = jax.jit(lambda dist, key: dist.sample(key, (points,)))
        tasks[f"log_prob: {name}"] = common.Task(lambda f=log_prob, d=dist: jax.block_until_ready(f(d, x)))
        tasks[f"sample: {name}"] = common.Task(lambda f=sample, d=dist: jax.block_until_ready(f(d, key)))
    grad = jax.jit(jax.grad(lambda dist, x: dist.log_prob(x).sum()))
    last = _distributions()["degree 3, envelope"]
    tasks["gradient: degree 3, envelope"] = common.Task(lambda: jax.block_until_ready(grad(last, x)))
    for name, peer in _peers().items():
        log_prob = jax.jit(lambda x, peer=peer: peer.log_prob(x))
        sample = jax.jit(lambda key, peer=peer: peer.sample(**_sample_arguments(peer, key, points)))
        np.testing.assert_allclose(log_prob(x), _ours().log_prob(x), rtol=1e-4, atol=1e-4)  # the same density
        tasks[f"log_prob: {name}"] = common.Task(lambda f=log_prob: jax.block_until_ready(f(x)))
        tasks[f"sample: {name}"] = common.Task(lambda f=sample: jax.block_until_ready(f(key)))
    read = jax.jit(lambda x: x[:, 0] + x[:, 1] * x[:, 2])  # what reading x and writing one number a point costs
    tasks["memory floor"] = common.Task(lambda: jax.block_until_ready(read(x)))
    return tasks


def _first_calls() -> dict[str, float]:
    """Figures of eager first calls at 1,000 points, and of integrals over time for a second number of points."""
    dist, x = _distributions()["degree 3, envelope"], np.random.default_rng(common.SEED).normal(size=(1000, 3)) * 0.3
    x, key, space = x.astype(np.float32), jax.random.key(common.SEED), dist.marginal((0, 1))
    calls = {
        "log_prob": lambda: dist.log_prob(x),
        "sample": lambda: dist.sample(key, (1000,)),
        "moments": dist.moments,
        "grad_log_prob": lambda: dist.grad_log_prob(x),
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


def _sample_arguments(peer, key, points: int) -> dict[str, object]:
    numpyros = type(peer).__module__.startswith("numpyro")
    return {"key": key, "sample_shape": (points,)} if numpyros else {"seed": key, "sample_shape": (points,)}


def _figures(median: dict[str, float]) -> dict[str, float]:
    figures = {f"{name} (ms)": 1e3 * seconds for name, seconds in median.items()}
    for kind in ("log_prob", "sample"):
        own = median[f"{kind}: foldgauss"]
        for peer in ("numpyro", "tfp"):
            if f"{kind}: {peer}" in median:
                figures[f"{kind}: speed against {peer}"] = median[f"{kind}: {peer}"] / own
        for name in list(_distributions())[1:]:
            figures[f"{kind}: cost of {name}"] = median[f"{kind}: {name}"] / own
    return figures


def main(arguments: list[str] | None = None) -> None:
    made = common.parser(__doc__)
    made.add_argument("--points", type=common.whole, default=1_000_000)
    made.add_argument("--rounds", type=common.whole, default=7)
    options = common.parse(made, arguments)
    jnp.zeros(1).block_until_ready()
    first = _first_calls()
    seconds = common.interleaved(_tasks(options.points), options.rounds)
    figures = first | _figures({name: float(np.median(times)) for name, times in seconds.items()})
    common.finish(options.json, figures, common.machine(), points=options.points)


if __name__ == "__main__":
    main()
