"""The extremes: float32 log-densities against float64, and float64 against extended precision, in excess wrong bits.

    python -m benchmarks.numerics [--json FILE]

Excess wrong bits = log2(error in units of the last place) - log2(condition number), at the same inputs. The condition
number is that of the log-density with respect to every input (point and parameters), sum |x dlogp/dx| / |logp|: what no
algorithm can win back. A row shows its worst over tau, residual and power. "off" counts the points where one of the two
is -inf and the other is not although the condition number is finite; it must be 0, and so must "NaN".
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import _common as common
from foldgauss.distribution import FoldedGaussian
from foldgauss.envelope import TimeLikelihood
from foldgauss.fold import PolynomialFold

TAUS = (0.0, 5.0, 13.0, 14.0, 19.0, 40.0, 1e3)
RESIDUALS = (0.0, 1e-30, 1.0, 1e20)
POWERS = (1.0, 2.0)
#: Most excess wrong bits allowed.
BOUND = 8.0


class Case(NamedTuple):
    """One row of the table; `condition` is that of Sigma, `offset` is added to space and to time (times its scale)."""

    name: str
    dim: int = 3
    degree: int = 3
    time_scale: float = 0.3
    condition: float = 10.0
    offset: float = 0.0


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
    rows = rng.normal(size=(case.degree, dim)) / scale ** np.arange(1, case.degree + 1)[:, None] / 4
    dist = FoldedGaussian(
        (rng.normal(size=dim) + case.offset).astype(dtype),
        tril,
        time_loc=np.asarray(0.4 + case.offset * scale, dtype),
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
        wide = jax.tree.map(lambda leaf: leaf.astype(np.float64), dist)
        reference, by_leaf = evaluate(wide, x.astype(np.float64))
    inputs = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves((wide, x))]
    with np.errstate(all="ignore"):
        moved = sum(map(_movement, inputs, jax.tree.leaves(by_leaf)))
        truth = reference
        if dtype == np.float64:  # the slope at the truth: where float64 sees a residual of exactly 0, its own is 0
            truth, at_truth = extended(wide, x).T
            moved = np.maximum(moved, at_truth)
        condition = np.maximum(moved / np.abs(reference), 1.0)
        ulps = np.abs(value.astype(np.longdouble) - truth) / np.spacing(np.abs(truth).astype(dtype))
        excess = (np.log2(np.maximum(ulps, 1.0)) - np.log2(condition)).astype(np.float64)
    both = np.isfinite(value) & np.isfinite(truth) & (np.abs(truth) < np.finfo(dtype).max)
    tame = np.isfinite(condition) & (condition < 1 / np.finfo(dtype).eps)
    off = np.isneginf(value) & (truth > -0.01 * float(np.finfo(dtype).max)) & tame
    return {
        "excess": float(excess[both].max(initial=-np.inf)),
        "compared": int(both.sum()),
        "-inf": int(np.isneginf(value).sum()),
        "off": int(off.sum()),
        "NaN": int(np.isnan(value).sum() + sum(np.isnan(g).sum() for g in jax.tree.leaves(grads))),
        "infinite slopes": int(sum(np.isinf(g).sum() for g in jax.tree.leaves(grads))),
    }


def _movement(x: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """sum |x dlogp/dx| per point: an input that is 0 has no relative error to pass on, however steep the slope."""
    terms = np.where(x == 0, 0, np.abs(x.astype(np.longdouble) * slope))
    return terms.reshape(len(x), -1).sum(-1)


def extended(dist: FoldedGaussian, x: np.ndarray) -> np.ndarray:
    """eq:foldgauss in NumPy's long double, and |x dlogp/dx| by space: (points, 2), straight from the book."""
    wide = lambda leaf: np.asarray(leaf).astype(np.longdouble)  # noqa: E731
    leaves = [wide(leaf) for leaf in (dist.loc, dist.scale_tril, dist.time_loc, dist.time_scale)]
    every = zip(*leaves, wide(dist.fold.coefficients), wide(dist.envelope.power), wide(x), strict=True)
    return np.array([_extended_one(*arguments) for arguments in every])


def _extended_one(loc, tril, time_loc, time_scale, coefficients, power, x):
    u = time_loc - x[-1]
    tau = u / time_scale
    shift = np.zeros_like(loc)
    for row in coefficients[::-1]:
        shift = u * (shift + row)
    residual, z = x[:-1] - loc - shift, np.zeros_like(loc)
    for i in range(len(loc)):
        z[i] = (residual[i] - (tril[i, :i] * z[:i]).sum()) / tril[i, i]
    half_log_a = -power * tau * tau / 4
    white = np.sign(z) * np.exp(np.log(np.abs(z)) - half_log_a)
    log_det = np.log(np.diagonal(tril)).sum() + np.log(time_scale) + len(loc) * half_log_a
    slope = np.linalg.solve(tril.T.astype(float), z.astype(float)).astype(np.longdouble)
    slope = np.sign(slope) * np.exp(np.log(np.abs(slope)) - 2 * half_log_a)
    moved = (np.abs(slope) * (np.abs(x[:-1]) + np.abs(loc) + np.abs(shift))).sum()
    log_prob = (
        -(white * white).sum() / 2 - tau * tau / 2 - log_det - (len(loc) + 1) * np.log(2 * np.longdouble(np.pi)) / 2
    )
    return log_prob, np.nan_to_num(moved)


def main(arguments: list[str] | None = None) -> None:
    options = common.parse(common.parser(__doc__), arguments)
    figures: dict[str, float] = {}
    for dtype in (np.float32, np.float64):
        name = np.dtype(dtype).name
        against = "float64" if dtype == np.float32 else "long double"
        shown, columns = None, None
        for case in cases(dtype):
            row = excess_bits(case, dtype)
            columns = columns or list(row)
            shown = shown or common.table(f"{name} against {against}: excess wrong bits", "case", *columns)
            shown.add_row(
                case.name, *(f"{value:.1f}" if isinstance(value, float) else str(value) for value in row.values())
            )
            figures[f"{name}, {case.name}: excess wrong bits"] = row["excess"]
            figures[f"{name}, {case.name}: NaN"] = row["NaN"]
        common.console.print(shown)
    figures["worst excess wrong bits"] = max(v for k, v in figures.items() if k.endswith("bits"))
    common.finish(options.json, figures, common.machine())


if __name__ == "__main__":
    main()
