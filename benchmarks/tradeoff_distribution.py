"""Speed against accuracy on the side of the distribution: precision, and how an E-step is computed.

    python -m benchmarks.tradeoff_distribution [--json FILE] [--points N] [--components K] [--rounds N]

**Precision**: log-densities and their gradient by every parameter (degree 3, envelope), float32 beside float64. The
error is the largest difference to float64, relative to 1 + |value|; `benchmarks.numerics` has that at the extremes.

**E-step**: responsibilities of a mixture with linear folds and a = 1, whose density is a quadratic form of (s, t).
*whitening*, as this package computes it, makes L^-1 of the residual of every pair of point and component; *matrix
product* multiplies the monomials of a point (10 for d = 3) by the coefficients of every component, once for all. The
error is the largest one of the log-likelihood of a point, against whitening in float64. It is measured for the points
as they are, and for points shifted from the origin by a multiple of their standard deviation, as in data that have not
been centered.

Tasks take turns; times are medians.
"""

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from benchmarks._common import Task
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import Constant, TimeLikelihood
from foldgauss.estimator.em.components import Parameters, evaluate_densities
from foldgauss.fold import PolynomialFold

SHIFTS = (0.0, 10.0, 100.0)


def precision(num: int, rounds: int, figures: dict[str, float]) -> None:
    tasks, results, wide = {}, {}, {}
    rng = np.random.default_rng(_common.SEED)
    coefficients, noise = 0.1 * rng.normal(size=(3, 2)), rng.normal(size=(num, 3))
    for dtype in (np.float64, np.float32):
        name = np.dtype(dtype).name
        with jax.enable_x64(True):
            dist = FoldedGaussian(
                np.array([0.1, -0.4], dtype),
                np.array([[0.3, 0.0], [0.1, 0.2]], dtype),
                time_loc=dtype(0.5),
                time_scale=dtype(0.3),
                fold=PolynomialFold(coefficients.astype(dtype)),
                envelope=TimeLikelihood(dtype(1)),
            )
            x = jnp.asarray((0.4 * noise).astype(np.float32).astype(dtype))
            log_prob = jax.jit(lambda dist, x: dist.log_prob(x))
            grad = jax.jit(jax.grad(lambda dist, x: dist.log_prob(x).sum()))
            wide[name] = {"log_prob": (log_prob, dist, x), "gradient": (grad, dist, x)}
            results[name] = {
                what: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(f(d, y))])
                for what, (f, d, y) in wide[name].items()
            }
            for what, (f, d, y) in wide[name].items():
                tasks[what, name] = Task(lambda f=f, d=d, y=y: jax.block_until_ready(f(d, y)))
    with jax.enable_x64(True):
        seconds = _common.interleaved(tasks, rounds)
    shown = _common.table(f"{num:,} points of degree 3 with an envelope", "what", "float32, ms", "float64, ms", "error")
    for what in ("log_prob", "gradient"):
        own, truth = results["float32"][what].astype(np.float64), results["float64"][what]
        error = float((np.abs(own - truth) / (1 + np.abs(truth))).max())
        times = [1e3 * float(np.median(seconds[what, name])) for name in ("float32", "float64")]
        figures |= {f"{what}, float32 (ms)": times[0], f"{what}, float64 (ms)": times[1], f"{what}: error": error}
        shown.add_row(what, *(f"{ms:.2f}" for ms in times), f"{error:.0e}")
    _common.console.print(shown)


def mixture(components: int, dtype, shift: float) -> Parameters:
    """Linear folds; everything is moved by `shift` in space and time."""
    rng = np.random.default_rng(_common.SEED)
    factors = np.tril(rng.normal(size=(components, 2, 2)) * 0.2)
    factors[:, [0, 1], [0, 1]] = 0.2 + np.abs(factors[:, [0, 1], [0, 1]])
    loc, slope = rng.normal(size=(2, components, 2))
    return Parameters(
        log_weights=np.full(components, -np.log(components), dtype),
        time_loc=(rng.normal(size=components) + shift).astype(dtype),
        time_scale=np.exp(0.3 * rng.normal(size=components) - 1).astype(dtype),
        curve=np.stack([loc + shift, 0.3 * slope], 1).astype(dtype),
        tril=factors.astype(dtype),
    )


def coefficients_of(params: Parameters) -> np.ndarray:
    """Of the monomials of (s, t) in each component's weighted log-density, float64 (10, k)."""
    p = Parameters(*(np.asarray(leaf, np.float64) for leaf in params))
    columns = []
    for k in range(len(p.time_loc)):
        # s = m_s + c v + L e with v = (m_t - t) / sigma_t: a Gaussian over (s, t), linear in (e, v).
        root = np.zeros((3, 3))
        root[:2, :2], root[:2, 2], root[2, 2] = p.tril[k], p.curve[k, 1], -p.time_scale[k]
        inverse, mean = np.linalg.inv(root), np.append(p.curve[k, 0], p.time_loc[k])
        matrix = inverse.T @ inverse
        log_det = np.log(np.abs(np.linalg.det(root)))
        constant = p.log_weights[k] - log_det - 1.5 * np.log(2 * np.pi) - 0.5 * mean @ matrix @ mean
        squares = [-0.5 * matrix[i, i] if i == j else -matrix[i, j] for i in range(3) for j in range(i, 3)]
        columns.append([*squares, *(matrix @ mean), constant])
    return np.array(columns).T


@jax.jit
def by_whitening(params: Parameters, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Log-likelihood of every point, and responsibilities."""
    log_density = evaluate_densities(params, Constant(), x).log_density
    total = jax.nn.logsumexp(log_density, axis=-1)
    return total, jnp.exp(log_density - total[:, None])


@jax.jit
def by_product(coefficients: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    monomials = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
    features = jnp.stack([*monomials, *x.T, jnp.ones_like(x[:, 0])], 1)
    log_density = jnp.matmul(features, coefficients, precision=jax.lax.Precision.HIGHEST)
    total = jax.nn.logsumexp(log_density, axis=-1)
    return total, jnp.exp(log_density - total[:, None])


def e_step(num: int, components: int, rounds: int, figures: dict[str, float]) -> None:
    tasks, errors = {}, {}
    for shift in SHIFTS:
        with jax.enable_x64(True):
            params = mixture(components, np.float32, shift)
            wide = Parameters(*(leaf.astype(np.float64) for leaf in params))
            rng = np.random.default_rng(1)
            x = (rng.normal(size=(num, 3)) + shift).astype(np.float32)
            truth = np.asarray(by_whitening(wide, jnp.asarray(x.astype(np.float64)))[0])
            for dtype in (np.float32, np.float64):
                name = np.dtype(dtype).name
                y = jnp.asarray(x.astype(dtype))
                own = params if dtype == np.float32 else wide
                ways = {
                    "whitening": (by_whitening, jax.tree.map(jnp.asarray, own)),
                    "matrix product": (by_product, jnp.asarray(coefficients_of(params).astype(dtype))),
                }
                for way, (function, given) in ways.items():
                    found = np.asarray(function(given, y)[0], np.float64)
                    errors[way, name, shift] = float(np.abs(found - truth).max())
                    if shift == 0:
                        tasks[way, name] = Task(lambda f=function, g=given, y=y: jax.block_until_ready(f(g, y)))
    with jax.enable_x64(True):
        seconds = _common.interleaved(tasks, rounds)
    columns = [f"error, {shift:g} away" if shift else "error" for shift in SHIFTS]
    shown = _common.table(f"E-step, {num:,} points, {components} components", "way", "ms", *columns)
    for (way, name), spans in seconds.items():
        own = [errors[way, name, shift] for shift in SHIFTS]
        milli = 1e3 * float(np.median(spans))
        shown.add_row(f"{way}, {name}", f"{milli:.1f}", *(f"{error:.0e}" for error in own))
        figures[f"E-step, {way}, {name} (ms)"] = milli
        figures |= {f"E-step, {way}, {name}: {c}": error for c, error in zip(columns, own, strict=True)}
    _common.console.print(shown)


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--points", type=_common.whole, default=100_000, help="[100000]")
    made.add_argument("--components", type=_common.whole, default=64, help="[64]")
    made.add_argument("--rounds", type=_common.whole, default=7, help="[7]")
    options = _common.parse(made, arguments)
    facts, figures = _common.describe_machine(), {}
    precision(options.points, options.rounds, figures)
    e_step(options.points, options.components, options.rounds, figures)
    _common.finish(options.json, figures, facts, points=options.points, components=options.components)


if __name__ == "__main__":
    main()
