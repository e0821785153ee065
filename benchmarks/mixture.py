"""Mixtures beside scikit-learn's and gmmx's: log-densities, one iteration of EM, and what bending brings.

    python -m benchmarks.mixture [--points [N ...]] [--components K] [--rounds N] [--skip-bending] [--json FILE]

d = 3, full covariances, a linear fold and a = 1: the model that all of them have. scikit-learn computes in float64,
gmmx in float32; gmmx is measured where it imports (`pip install gmmx`). Ratios above 1 mean that foldgauss is faster;
all are of medians of one run in which the tasks take turns. Errors are the largest against scikit-learn's float64.
Bending: mixtures chosen by BIC or by cross-validation (tracks kept whole), the mean log-density of points held out, and
its difference to scikit-learn's by the same rule (± one standard error, a track being one draw).
"""

import contextlib
import importlib.util
import time

import jax
import jax.numpy as jnp
import numpy as np
from sklearn.mixture import GaussianMixture

from benchmarks import _bending, _common
from foldgauss.envelope import Constant
from foldgauss.estimator.em.initialization import params_from_gaussians
from foldgauss.estimator.em.loop import State, _step_restarts, broadcast_degrees
from foldgauss.estimator.em.m_step import Model
from foldgauss.estimator.em.scaling import Scaling, to_mixture
from foldgauss.estimator.em.statistics import make_points
from foldgauss.estimator.folded_gaussian_mixture import FoldedGaussianMixture

DIM = 3
REG = 0.0  # scikit-learn adds it to the covariance as a whole, foldgauss to that of space given time and to time's


class Problem:
    """Points from a mixture, and one start for all."""

    def __init__(self, num: int, components: int):
        rng = np.random.default_rng(_common.SEED)
        means = rng.normal(size=(components, DIM)) * 2
        factors = rng.normal(size=(components, DIM, DIM)) * 0.3 + 0.3 * np.eye(DIM)
        labels = rng.integers(0, components, num)
        self.x = means[labels] + np.einsum("nij,nj->ni", factors[labels], rng.normal(size=(num, DIM)))
        self.weights = np.full(components, 1 / components)
        self.means = means + 0.1 * rng.normal(size=means.shape)
        self.covariances = np.einsum("kij,klj->kil", factors, factors) + 0.1 * np.eye(DIM)


def _scikit_learns(problem: Problem) -> tuple[dict, dict]:
    """Tasks, and their results once."""
    model = GaussianMixture(len(problem.weights), reg_covar=REG)
    model.weights_, model.means_, model.covariances_ = problem.weights, problem.means, problem.covariances
    model.precisions_cholesky_ = np.linalg.inv(np.linalg.cholesky(problem.covariances)).swapaxes(1, 2)

    def em():
        stepped = GaussianMixture(len(problem.weights), reg_covar=REG)
        stepped.__dict__.update(model.__dict__)
        _, log_shares = stepped._e_step(problem.x)
        stepped._m_step(problem.x, log_shares)
        return stepped.means_, stepped.covariances_

    return {"score": lambda: model.score_samples(problem.x), "em": em}


def _ours(problem: Problem, dtype) -> dict:
    num, x = len(problem.weights), problem.x.astype(dtype)
    scaling = Scaling(problem.x.mean(0), problem.x.std(0))
    scale = scaling.scale
    params = params_from_gaussians(
        problem.weights,
        (problem.means - scaling.shift) / scale,
        problem.covariances / (scale[:, None] * scale),
        1,
        dtype,
    )
    fitted = FoldedGaussianMixture(num, degree=1)
    fitted._params, fitted._scaling, fitted._envelope = (
        type(params)(*map(np.asarray, params)),
        scaling,
        Constant(),
    )
    fitted.n_features_in_, fitted.weights_ = DIM, problem.weights
    points = make_points(scaling.apply(x), np.ones(len(x), dtype), num)
    state = jax.tree.map(lambda z: z[None], State(params, jnp.ones_like(params.time_loc)))
    model = Model(broadcast_degrees(1, num), jnp.asarray(REG / scale**2, dtype), "full")
    frozen = jnp.zeros(1, bool)

    def em():
        new = jax.block_until_ready(_step_restarts(state, frozen, points, Constant(), model, None))[0].params
        mixture = to_mixture(jax.tree.map(lambda z: z[0], new), scaling, Constant())
        return tuple(map(np.asarray, mixture.components.moments()))

    def em_alone():
        return jax.block_until_ready(_step_restarts(state, frozen, points, Constant(), model, None))

    return {"score": lambda: fitted.score_samples(x), "em": em_alone, "em result": em}


def _gmmxs(problem: Problem) -> dict:
    import gmmx

    x = jnp.asarray(problem.x, jnp.float32)
    start = {"means": problem.means, "covariances": problem.covariances, "weights": problem.weights}
    model = gmmx.GaussianMixtureModelJax.from_squeezed(**{k: jnp.asarray(v, jnp.float32) for k, v in start.items()})
    fitter = gmmx.EMFitter(max_iter=1, reg_covar=REG)
    step = jax.jit(lambda x, model: fitter.m_step(x, model, fitter.e_step(x, model)[1]))
    score = jax.jit(lambda x, model: model.score_samples(x))
    return {
        "score": lambda: jax.block_until_ready(score(x, model)),
        "em": lambda: jax.block_until_ready(step(x, model)),
    }


def _measured(num: int, components: int, rounds: int) -> tuple[dict[str, float], dict[str, float]]:
    """Median seconds by "who: task", and errors."""
    problem = Problem(num, components)
    with jax.enable_x64(True):
        double = _ours(problem, np.float64)
    engines = {
        "sklearn": (_scikit_learns(problem), contextlib.nullcontext),
        "float32": (_ours(problem, np.float32), contextlib.nullcontext),
        "float64": (double, lambda: jax.enable_x64(True)),
    }
    if importlib.util.find_spec("gmmx") and num <= 100_000:  # it keeps n k d^2 numbers
        engines["gmmx"] = (_gmmxs(problem), contextlib.nullcontext)
    errors, truth = {}, {}
    for who, (tasks, precision) in engines.items():
        with precision():
            found = tasks["score"]()  # which also compiles
            stepped = (tasks.get("em result") or tasks["em"])()
            tasks["em"]()
        if who == "sklearn":
            truth = {"score": found, "step": stepped}
        elif who != "gmmx":
            errors[f"{who}: score"] = float(np.abs(found - truth["score"]).max())
            errors[f"{who}: means"] = float(np.abs(stepped[0] - truth["step"][0]).max())
            errors[f"{who}: covariances"] = float(np.abs(stepped[1] - truth["step"][1]).max())
    seconds = {f"{who}: {task}": [] for who in engines for task in ("score", "em")}
    for _ in range(rounds):
        for who, (tasks, precision) in engines.items():
            for task in ("score", "em"):
                time.sleep(_common.PAUSE)
                with precision():
                    begun = time.perf_counter()
                    result = tasks[task]()
                    seconds[f"{who}: {task}"].append(time.perf_counter() - begun)
                del result
    return {name: float(np.median(values)) for name, values in seconds.items()}, errors


def _shown(num: int, components: int, median: dict[str, float], errors: dict[str, float]) -> dict[str, float]:
    title = f"{num:,} points, {components} components"
    shown = _common.table(
        title, "who", "score (ms)", "EM step (ms)", "error: score", "error: means", "error: covariances"
    )
    figures = {}
    for who in dict.fromkeys(name.partition(":")[0] for name in median):
        each = [
            f"{errors[f'{who}: {what}']:.1e}" if f"{who}: {what}" in errors else ""
            for what in ("score", "means", "covariances")
        ]
        shown.add_row(who, *(f"{1e3 * median[f'{who}: {task}']:.1f}" for task in ("score", "em")), *each)
    _common.console.print(shown)
    for task in ("score", "em"):
        for rival in ("sklearn", "gmmx"):
            if f"{rival}: {task}" in median:
                for dtype in ("float32", "float64"):
                    name = f"{task}_over_{rival}" + ("" if dtype == "float32" else "_float64")
                    figures[f"{name} {num}"] = median[f"{rival}: {task}"] / median[f"{dtype}: {task}"]
    return figures | {f"error {name} {num}": value for name, value in errors.items()}


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
    made.add_argument(
        "--points", type=_common.whole, nargs="*", default=[100_000, 1_000_000], help="none: bending alone"
    )
    made.add_argument("--components", type=_common.whole, default=64)
    made.add_argument("--rounds", type=_common.whole, default=3)
    made.add_argument("--skip-bending", action="store_true", help="speed alone")
    options = _common.parse(made, arguments)
    figures = {}
    for num in options.points:
        figures |= _shown(num, options.components, *_measured(num, options.components, options.rounds))
    for num in sorted(options.points):  # the figures' plain names: at the most points that each was measured at
        for name in [name for name in figures if name.endswith(f" {num}") and "_over_" in name]:
            figures[name.rpartition(" ")[0]] = figures[name]
    if not options.skip_bending:
        figures |= _bends()
    _common.finish(
        options.json, figures, _common.describe_machine(), points=options.points, components=options.components
    )


if __name__ == "__main__":
    main()
