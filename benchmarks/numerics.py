"""The extremes: log-densities and their gradients, float32 and float64, against long double, in excess wrong bits.

    python -m benchmarks.numerics [--json FILE]

**Values.** Excess wrong bits = log2(error in units of the last place) - log2(condition number), at the same inputs. The
condition number is that of the log-density with respect to every input (point and parameters),
sum |x dlogp/dx| / |logp|: what no algorithm can win back.

**Gradients**, by the point and by every parameter: log2(error / max(eps |g|, change)), where `change` is the largest
that half a unit in the last place of every input, up or down at random, makes in the true gradient. Where the gradient
is beyond `steepest`, the limit of exact derivatives, only its sign is asked for; where the log-density is -inf, 0. They
are not compared where the log-density is beyond that limit, or |tau| above 13 (float64: 37).

A row shows its worst over tau, residual and power. "off" counts log-densities that are -inf and should not be though
the condition number is finite; "wrong ends" gradients beyond the limit that have the wrong sign, or that are not 0
where they should be. Both must be 0, and so must "NaN".
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common
from foldgauss._numerics.batch import steepest
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import PolynomialFold

TAUS = (0.0, 5.0, 13.0, 14.0, 19.0, 40.0, 1e3)
RESIDUALS = (0.0, 1e-30, 1.0, 1e20)
POWERS = (1.0, 2.0)
#: Gradients are exact for |tau| below this.
EXACT = {np.float32: 13.5, np.float64: 37.5}
#: Most excess wrong bits allowed.
BOUND = 8.0


class Case(NamedTuple):
    """One row of the table; `condition` is that of Sigma, `offset` is added to space and to time (times its scale).

    `centered` puts loc and time_loc at 0: there residuals as small as 1e-30 are seen, which drown beside a loc of 1.
    `resting` makes all coefficients 0, so that this is so for a fold too: slopes by coefficients remain.
    """

    name: str
    dim: int = 3
    degree: int = 3
    time_scale: float = 0.3
    condition: float = 10.0
    offset: float = 0.0
    centered: bool = False
    resting: bool = False


def cases(dtype) -> list[Case]:
    """The rows of issue "The Folded-Gaussian as a first-class distribution"."""
    condition, offset = (1e6, 1e4) if dtype == np.float32 else (1e14, 1e8)
    return [
        Case("plain"),
        Case("degree 0", degree=0),
        Case("degree 12", degree=12),
        Case("time_scale 1e-12", time_scale=1e-12),
        Case("time_scale 1e6", time_scale=1e6),
        Case(f"condition {condition:.0e}", condition=condition),
        Case(f"offset {offset:.0e}", offset=offset),
        Case("d 2", dim=2),
        Case("d 10", dim=10),
        Case("d 64", dim=64),
        Case("d 64, condition", dim=64, condition=condition),
        Case("centered", degree=0, centered=True),
        Case("centered, resting fold", centered=True, resting=True),
        Case("centered, resting fold, time_scale 1e-3", centered=True, resting=True, time_scale=1e-3),
        Case("centered, resting fold, time_scale 1e6", centered=True, resting=True, time_scale=1e6),
        Case("centered, condition, time_scale 1e-12", degree=0, centered=True, condition=condition, time_scale=1e-12),
        # Not degree 12: XLA on the CPU takes coefficients below the smallest normal number for 0.
        Case("condition, time_scale 1e6, degree 5", condition=condition, time_scale=1e6, degree=5),
        Case("condition, offset, time_scale 1e-12", condition=condition, offset=offset, time_scale=1e-12),
    ]


def build(case: Case, dtype) -> tuple[FoldedGaussian, np.ndarray]:
    """The distribution and its points, one per (tau, residual, power); powers are its batch."""
    rng = np.random.default_rng(0)
    tau, residual, power = (axis.ravel() for axis in np.meshgrid(TAUS, RESIDUALS, POWERS, indexing="ij"))
    dim, scale = case.dim - 1, case.time_scale
    turn = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    root = turn * np.logspace(0, -0.5 * np.log10(case.condition), dim)  # Sigma = root root^T
    tril = np.linalg.qr(root.T)[1].T
    tril = (tril * np.sign(np.diagonal(tril))).astype(dtype)  # columns: Sigma stays the same
    rows = (
        (not case.resting) * rng.normal(size=(case.degree, dim)) / scale ** np.arange(1, case.degree + 1)[:, None] / 4
    )
    dist = FoldedGaussian(
        np.zeros(dim, dtype) if case.centered else (rng.normal(size=dim) + case.offset).astype(dtype),
        tril,
        time_loc=np.asarray((0.0 if case.centered else 0.4) + case.offset * scale, dtype),
        time_scale=np.asarray(scale, dtype),
        fold=PolynomialFold(rows.astype(dtype)),
        envelope=TimeLikelihood(power.astype(dtype)),
    )
    t = np.asarray(dist.time_loc) + (tau * scale).astype(dtype)
    s = np.asarray(eqx.filter_jit(lambda d, t: d.condition_time(t).loc)(dist, t))
    s = s + (residual[:, None] * rng.choice([-1.0, 1.0], size=dim)).astype(dtype)
    return dist, np.concatenate([s, t[:, None]], axis=-1).astype(dtype)


def evaluate(dist: FoldedGaussian, x: np.ndarray) -> tuple[np.ndarray, tuple]:
    """Log-densities and their gradients by every leaf and by x, point by point."""
    one = jax.value_and_grad(lambda dist, x: dist.log_prob(x), argnums=(0, 1))
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(dist, jnp.asarray(x)))


def excess_bits(case: Case, dtype) -> dict[str, float]:
    """The worst excess of one case, with what else must hold of it."""
    with jax.enable_x64(True):
        dist, x = build(case, dtype)
        value, grads = evaluate(dist, x)
    inputs = _wide(dist, x)
    with np.errstate(all="ignore"):
        truth, slopes = extended(*inputs)
        moved = sum(map(_movement, inputs, slopes))
        condition = np.maximum(moved / np.abs(truth), 1.0)
        ulps = np.abs(value - truth) / np.spacing(np.abs(truth).astype(dtype))
        excess = (np.log2(np.maximum(ulps, 1.0)) - np.log2(condition)).astype(np.float64)
        changes = _changes(inputs, slopes, dtype)
    largest = np.longdouble(np.finfo(dtype).max)
    both = np.isfinite(value) & np.isfinite(truth) & (np.abs(truth) < largest)
    tame = np.isfinite(condition) & (condition < 1 / np.finfo(dtype).eps)
    off = np.isneginf(value) & (truth > -0.01 * largest) & tame
    own = [*jax.tree.leaves(grads[0]), grads[1]]
    # Where float sees a residual of 0 and the truth is -inf, or the other way round, all slopes are another point's.
    same = np.isneginf(value) == (np.isneginf(truth) | (truth < -largest))
    tau = (inputs[-1][:, -1] - inputs[2]) / inputs[3]
    same &= np.isneginf(value) | ((np.abs(value) < steepest(dtype)) & (np.abs(tau) < EXACT[dtype]))
    each = zip(own, slopes, changes, strict=True)
    kept = [_gradient_excess(g, true, change, value, same, dtype) for g, true, change in each]
    return {
        "excess": float(excess[both].max(initial=-np.inf)),
        "gradient's excess": max(float(bits) for bits, _, _ in kept),
        "compared": int(both.sum()),
        "slopes": int(sum(count for _, _, count in kept)),
        "-inf": int(np.isneginf(value).sum()),
        "off": int(off.sum()),
        "wrong ends": int(sum(wrong for _, wrong, _ in kept)),
        "NaN": int(np.isnan(value).sum() + sum(np.isnan(g).sum() for g in own)),
    }


def _movement(x: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """sum |x dlogp/dx| per point: an input that is 0 has no relative error to pass on, however steep the slope."""
    return np.where(x == 0, 0, np.abs(x * slope)).reshape(len(x), -1).sum(-1)


def _wide(dist: FoldedGaussian, x: np.ndarray) -> list[np.ndarray]:
    """loc, tril, time_loc, time_scale, coefficients, power, floor, x in long double, each for every point."""
    return [np.asarray(leaf).astype(np.longdouble) for leaf in (*jax.tree.leaves(dist), x)]


def _changes(inputs: list[np.ndarray], slopes: list[np.ndarray], dtype) -> list[np.ndarray]:
    """What half a unit in the last place of all inputs does to the true gradients, at the most of some draws."""
    rng, half_ulp = np.random.default_rng(1), 0.5 * np.finfo(dtype).eps
    changes = [np.zeros_like(g) for g in slopes]
    for _ in range(6):
        moved = [y * (1 + half_ulp * rng.choice([-1, 1], size=y.shape)) for y in inputs]
        again = extended(*moved)[1]
        changes = [np.fmax(c, np.abs(g - h)) for c, g, h in zip(changes, slopes, again, strict=True)]
    return changes


def _gradient_excess(own, truth, change, value, same, dtype) -> tuple[float, int, int]:
    """Worst excess bits of one leaf's gradients, how many are at wrong ends, and how many were compared."""
    largest, tiny = np.longdouble(steepest(dtype)), np.longdouble(np.finfo(dtype).tiny)
    nowhere, same = (flag.reshape(-1, *[1] * (own.ndim - 1)) for flag in (np.isneginf(value), same))
    size = np.abs(truth)
    with np.errstate(all="ignore"):  # a NaN, of infinities, compares as neither
        beyond = (size - 8 * change > largest) & same & ~nowhere
        within = (size + 8 * change < largest) & same & ~nowhere
        allowed = np.maximum(np.maximum(np.finfo(dtype).eps * size, change), tiny)
        bits = np.log2(np.maximum(np.abs(own - truth), allowed) / allowed)
    wrong = (beyond & (np.sign(own) != np.sign(truth))) | (nowhere & (own != 0))
    return float(bits[within].max(initial=0.0)), int(wrong.sum()), int((within | beyond).sum())


def extended(loc, tril, time_loc, time_scale, coefficients, power, floor, x) -> tuple[np.ndarray, list[np.ndarray]]:
    """eq:foldgauss and its gradient by every argument in NumPy's long double, straight from the book.

    Every argument has the points in front. The floor must be 0; the gradient by it is there all the same.
    """
    dim, t = loc.shape[-1], x[:, -1]
    u = time_loc - t
    tau = u / time_scale
    powers = u[:, None] ** np.arange(coefficients.shape[1] + 1)  # u^0 .. u^degree
    shift = (coefficients * powers[:, 1:, None]).sum(1)
    slope = (coefficients * (np.arange(1, powers.shape[1]) * powers[:, :-1])[:, :, None]).sum(1)
    residual, y = x[:, :-1] - loc - shift, np.zeros_like(loc)
    for i in range(dim):
        y[:, i] = (residual[:, i] - (tril[:, i, :i] * y[:, :i]).sum(-1)) / tril[:, i, i]
    half_log_a = -power * tau * tau / 4
    z = y * np.exp(-half_log_a)[:, None]
    w = np.zeros_like(loc)
    for i in reversed(range(dim)):
        w[:, i] = (z[:, i] - (tril[:, i + 1 :, i] * w[:, i + 1 :]).sum(-1)) / tril[:, i, i]
    diagonal, square = np.diagonal(tril, axis1=1, axis2=2), (z * z).sum(-1)
    log_det = np.log(diagonal).sum(-1) + np.log(time_scale) + dim * half_log_a
    log_prob = -square / 2 - tau * tau / 2 - log_det - (dim + 1) * np.log(2 * np.longdouble(np.pi)) / 2
    by_loc = w * np.exp(-half_log_a)[:, None]
    by_half_log_a = square - dim
    by_tau = -tau - by_half_log_a * power * tau / 2
    by_u = (by_loc * slope).sum(-1)
    by_tril = np.tril(w[:, :, None] * z[:, None, :]) - np.eye(dim) / diagonal[:, None, :]
    by_time_loc = by_tau / time_scale + by_u
    by_coefficients = by_loc[:, None, :] * powers[:, 1:, None]
    by_power = -by_half_log_a * tau * tau / 4
    by_floor = by_half_log_a * np.expm1(power * tau * tau / 2) / 2
    by_x = np.concatenate([-by_loc, -by_time_loc[:, None]], axis=-1)
    by_time_scale = -(by_tau * tau + 1) / time_scale
    return log_prob, [by_loc, by_tril, by_time_loc, by_time_scale, by_coefficients, by_power, by_floor, by_x]


def main(arguments: list[str] | None = None) -> None:
    options, figures = _common.parse(_common.parser(__doc__), arguments), {}
    for dtype in (np.float32, np.float64):
        name = np.dtype(dtype).name
        rows = {case.name: excess_bits(case, dtype) for case in cases(dtype)}
        columns = list(next(iter(rows.values())))
        cells = ((case, *(f"{value:.4g}" for value in row.values())) for case, row in rows.items())
        _common.print_table(f"{name}: excess wrong bits", ("case", *columns), cells)
        figures |= {f"{name}, {case}: {what}": row[what] for case, row in rows.items() for what in columns}
    _common.finish(options.json, figures)


if __name__ == "__main__":
    main()
