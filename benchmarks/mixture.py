"""Speed of mixtures beside scikit-learn's: whole fits, and log-densities. `benchmarks.density` measures quality.

    python -m benchmarks.mixture [--points N ...] [--components K] [--iterations I] [--rounds N] [--json FILE]

d = 3, full covariances, a linear fold and a = 1, the model that both have. Both start at the same parameters, make the
same number of iterations of EM, and compute in the same dtype. Ratios above 1 mean that foldgauss is faster; they are
of medians of rounds in which the two take turns.
"""

import time
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from benchmarks import _common
from foldgauss import FoldedGaussian, FoldedMixture, PolynomialFold
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

DIM = 3
COMPONENTS = 10
ITERATIONS = 20
DTYPES = (np.float32, np.float64)


def make_problem(num: int, components: int) -> tuple[np.ndarray, FoldedMixture, dict[str, np.ndarray]]:
    """Points from a mixture, and parameters near it as arguments of the two estimators."""
    rng = np.random.default_rng(_common.SEED)
    means = rng.normal(size=(components, DIM)) * 2
    factors = rng.normal(size=(components, DIM, DIM)) * 0.3 + 0.3 * np.eye(DIM)
    labels = rng.integers(0, components, num)
    x = means[labels] + np.einsum("nij,nj->ni", factors[labels], rng.normal(size=(num, DIM)))
    covariances = np.einsum("kij,klj->kil", factors, factors) + 0.1 * np.eye(DIM)
    weights, means = np.full(components, 1 / components), means + 0.1 * rng.normal(size=means.shape)
    variance = covariances[:, -1, -1]
    slope = covariances[:, :-1, -1] / variance[:, None]
    parts = FoldedGaussian(
        means[:, :-1],
        covariance_matrix=covariances[:, :-1, :-1] - slope[:, :, None] * covariances[:, None, :-1, -1],
        time_loc=means[:, -1],
        time_scale=np.sqrt(variance),
        fold=PolynomialFold(-slope[:, None]),
    )
    initial = {"weights_init": weights, "means_init": means, "precisions_init": np.linalg.inv(covariances)}
    return x, FoldedMixture(parts, weights=weights), initial


def time_fits(num: int, components: int, iterations: int, rounds: int) -> dict[str, float]:
    """Median seconds, by dtype, estimator and task, and the mean log-density that each fit reaches."""
    x, start, initial = make_problem(num, components)
    stopping = {"max_iter": iterations, "tol": 0.0}
    makers = {
        "foldgauss": lambda: FoldedGaussianMixture(components, degree=1, **stopping, start=start),
        "sklearn": lambda: GaussianMixture(components, **stopping, **initial),
    }
    seconds, figures = {}, {}
    for round_ in range(-1, rounds):  # the first round compiles
        for dtype in DTYPES:
            own = x.astype(dtype)
            for who, make in makers.items():
                begun = time.perf_counter()
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ConvergenceWarning)
                    fitted = make().fit(own)
                middle = time.perf_counter()
                scores = fitted.score_samples(own)
                if round_ >= 0:
                    seconds.setdefault((who, "fit", dtype), []).append(middle - begun)
                    seconds.setdefault((who, "score", dtype), []).append(time.perf_counter() - middle)
                figures[f"{who}, mean log-density, {dtype.__name__}, {num}"] = float(np.mean(scores, dtype=np.float64))
    medians = {f"{who}, {task} (s), {dtype.__name__}, {num}": np.median(v) for (who, task, dtype), v in seconds.items()}
    return figures | medians


def show_fits(num: int, components: int, iterations: int, figures: dict[str, float]) -> dict[str, float]:
    """Print the seconds, and return the ratios."""
    rows, ratios = [], {}
    for dtype in (dtype.__name__ for dtype in DTYPES):
        densities = (figures[f"{who}, mean log-density, {dtype}, {num}"] for who in ("foldgauss", "sklearn"))
        beside = [f"{value:.4f}" for value in densities]
        for task in ("fit", "score"):
            ours, theirs = (figures[f"{who}, {task} (s), {dtype}, {num}"] for who in ("foldgauss", "sklearn"))
            ratios[f"{task}_over_sklearn_{dtype} {num}"] = theirs / ours
            rows.append((f"{task}, {dtype}", f"{ours:.2f}", f"{theirs:.2f}", f"{theirs / ours:.1f}", *beside))
    columns = "task, dtype", "foldgauss (s)", "scikit-learn (s)", "ratio", "mean log-density", "scikit-learn's"
    _common.print_table(f"{num:,} points, {components} components, {iterations} iterations", columns, rows)
    return ratios


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--points", type=_common.whole, nargs="+", default=[1_000_000])
    made.add_argument("--components", type=_common.whole, default=COMPONENTS)
    made.add_argument("--iterations", type=_common.whole, default=ITERATIONS)
    made.add_argument("--rounds", type=_common.whole, default=3)
    options, figures = _common.parse(made, arguments), {}
    for num in options.points:
        figures |= time_fits(num, options.components, options.iterations, options.rounds)
        figures |= show_fits(num, options.components, options.iterations, figures)
    _common.finish(options.json, figures, points=options.points, components=options.components)


if __name__ == "__main__":
    main()
