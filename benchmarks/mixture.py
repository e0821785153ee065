"""Mixtures beside scikit-learn's: whole fits, log-densities, and what bending brings.

    python -m benchmarks.mixture [--points [N ...]] [--components K] [--iterations I] [--rounds N] [--skip-bending]
                                 [--json FILE]

Speed: d = 3, full covariances, a linear fold and a = 1, the model that both have. Both start at the same parameters,
make the same number of iterations of EM, and compute in the same dtype. Ratios above 1 mean that foldgauss is faster;
they are of medians of rounds in which the two take turns. Bending: mixtures chosen by BIC or by cross-validation
(tracks kept whole), the mean log-density of points held out, and its difference to scikit-learn's by the same rule (±
one standard error, a track being one draw).
"""

import time
import warnings

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from benchmarks import _bending, _common
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

DIM = 3
COMPONENTS = 10
ITERATIONS = 20
DTYPES = (np.float32, np.float64)


def make_problem(num: int, components: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points from a mixture, and parameters near it as arguments of both estimators."""
    rng = np.random.default_rng(_common.SEED)
    means = rng.normal(size=(components, DIM)) * 2
    factors = rng.normal(size=(components, DIM, DIM)) * 0.3 + 0.3 * np.eye(DIM)
    labels = rng.integers(0, components, num)
    x = means[labels] + np.einsum("nij,nj->ni", factors[labels], rng.normal(size=(num, DIM)))
    covariances = np.einsum("kij,klj->kil", factors, factors) + 0.1 * np.eye(DIM)
    start = {"weights": np.full(components, 1 / components), "means": means + 0.1 * rng.normal(size=means.shape)}
    start["precisions"] = np.linalg.inv(covariances)
    return x, {f"{name}_init": values for name, values in start.items()}


def time_fits(num: int, components: int, iterations: int, rounds: int) -> dict[str, float]:
    """Median seconds, by dtype, estimator and task, and the mean log-density that each fit reaches."""
    x, start = make_problem(num, components)
    stopping = {"max_iter": iterations, "tol": 0.0}
    makers = {
        "foldgauss": lambda: FoldedGaussianMixture(components, degree=1, **stopping, **start),
        "sklearn": lambda: GaussianMixture(components, **stopping, **start),
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
    title = f"{num:,} points, {components} components, {iterations} iterations"
    columns = ("task, dtype", "foldgauss (s)", "scikit-learn (s)", "ratio", "mean log-density", "scikit-learn's")
    table, ratios = _common.table(title, *columns), {}
    for dtype in (dtype.__name__ for dtype in DTYPES):
        densities = [figures[f"{who}, mean log-density, {dtype}, {num}"] for who in ("foldgauss", "sklearn")]
        for task in ("fit", "score"):
            ours, theirs = (figures[f"{who}, {task} (s), {dtype}, {num}"] for who in ("foldgauss", "sklearn"))
            ratios[f"{task}_over_sklearn_{dtype} {num}"] = theirs / ours
            shown = (f"{ours:.2f}", f"{theirs:.2f}", f"{theirs / ours:.1f}", *(f"{value:.4f}" for value in densities))
            table.add_row(f"{task}, {dtype}", *shown)
    _common.console.print(table)
    return ratios


def _bends() -> dict[str, float]:
    problems = {
        "crossing, normal times": lambda: _bending.curves("normal"),
        "crossing, uniform times": lambda: _bending.curves("uniform"),
        "feature tracks": _bending.tracks,
    }
    columns = ("data", "mixture, chosen by", "components", "parameters", "held out (nats/point)", "over scikit-learn's")
    shown = _common.table("Data that bend", *columns)
    figures = {}
    for name, compared in problems.items():
        sides, groups = compared()
        for who, side in sides.items():
            rival = sides["scikit-learn, CV" if "CV" in who else "scikit-learn, BIC"]
            gain, error = side.over(rival, groups)
            told = "" if side is rival else f"{gain:+.3f} ± {error:.3f}"
            shown.add_row(name, who, f"{side.components}", f"{side.parameters}", f"{side.held_out:.3f}", told)
            figures |= {f"{name}, {who}: held out": side.held_out, f"{name}, {who}: parameters": side.parameters}
    _common.console.print(shown)
    return figures


def main(arguments: list[str] | None = None) -> None:
    made = _common.parser(__doc__)
    made.add_argument("--points", type=_common.whole, nargs="*", default=[1_000_000], help="none: bending alone")
    made.add_argument("--components", type=_common.whole, default=COMPONENTS)
    made.add_argument("--iterations", type=_common.whole, default=ITERATIONS)
    made.add_argument("--rounds", type=_common.whole, default=3)
    made.add_argument("--skip-bending", action="store_true", help="speed alone")
    options = _common.parse(made, arguments)
    figures = {}
    for num in options.points:
        figures |= time_fits(num, options.components, options.iterations, options.rounds)
        figures |= show_fits(num, options.components, options.iterations, figures)
    if not options.skip_bending:
        figures |= _bends()
    _common.finish(
        options.json, figures, _common.describe_machine(), points=options.points, components=options.components
    )


if __name__ == "__main__":
    main()
