"""The EM iteration, for several restarts at once: convergence, annealing, resets of empty components.

**Source:** Dempster, Laird and Rubin 1977; generalized EM where the envelope depends on time.
"""

import functools
from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.envelope import AbstractEnvelope, Constant
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.m_step import Model, newton_step, profile_log_likelihood, update_components
from foldgauss.estimator.em.statistics import (
    Blocks,
    Points,
    SufficientStatistics,
    Times,
    accumulate,
    map_leading,
    step_times,
    sum_over_points,
)

#: Armijo's condition: the fraction of the predicted gain that a Newton step of the times must achieve.
_ARMIJO = 1e-4
#: Steps from the first inverse temperature to 1.
ANNEALING_STEPS = 50
#: Steps at temperature 1 before an annealed run may converge: components that coincide there separate slowly at first.
SETTLING_STEPS = 20
#: Mean log-likelihoods that differ by less than this many epsilons of their dtype count as equal.
_ROUNDING = 64
#: While annealing, centers are perturbed by this fraction of their standard deviation, so that coinciding components
#: can separate.
_JITTER = 0.05


class EMStatus(IntEnum):
    """How a run ended."""

    CONVERGED = 0
    NOT_CONVERGED = 1
    NOT_FINITE = 2
    SINGULAR = 3


class State(NamedTuple):
    params: Parameters
    step_fraction: Float[Array, " k"]  # of Newton's step of the times; reduced after a rejected step


class Info(NamedTuple):
    """Diagnostics of one step, for the parameters before it."""

    log_likelihood: Float[Array, ""]
    mass: Float[Array, " k"]
    stuck: Bool[Array, " k"]  # no update was possible
    rejected: Float[Array, ""]  # predicted gain of rejected steps of the times


class Run(NamedTuple):
    """The result of one restart: the last parameters, and the mean log-likelihood before each of its steps."""

    params: Parameters
    history: list[float]
    status: EMStatus

    @property
    def log_likelihood(self) -> float:
        """The last one that is finite."""
        return next((value for value in reversed(self.history) if np.isfinite(value)), -np.inf)


def step(
    states: State, points: Points | Blocks, envelope: AbstractEnvelope, model: Model, inverse_temperature=None
) -> tuple[State, Info]:
    """One iteration of all restarts: exact EM for a constant envelope, else generalized EM with an ascent step of the
    times. The sums are one program, called for each block of points, and the M-step another."""
    sums = functools.partial(sum_over_points, _accumulate, points, states.params, envelope)
    here = sums(None, 2, inverse_temperature)
    if isinstance(envelope, Constant):
        return _m_step(model, states, here)
    steps, predicted, times = _propose_times(model, states, here)
    there = sums(times, 0, inverse_temperature)
    return _m_step_with_times(model, states, here, there, steps, predicted)


def _accumulate(params: Parameters, envelope, times: Times | None, order: int, inverse_temperature, points: Points):
    def one(params, times):
        return accumulate(params, envelope, points, times=times, order=order, inverse_temperature=inverse_temperature)

    return map_leading(one, params, times)


def _over_restarts(function):
    """The compiled function of a model, and of arrays with a leading axis of restarts, from that of one restart."""
    return eqx.filter_jit(lambda model, *arguments: map_leading(functools.partial(function, model), *arguments))


@_over_restarts
def _m_step(model: Model, state: State, sums: SufficientStatistics) -> tuple[State, Info]:
    new, stuck = update_components(state.params, sums, model)
    return State(new, state.step_fraction), Info(sums.log_likelihood, sums.mass, stuck, jnp.zeros((), sums.mass.dtype))


@_over_restarts
def _propose_times(model: Model, state: State, here: SufficientStatistics):
    """Steps of the times (2, k), the gains that they promise, and the times after them."""
    direction, predicted = newton_step(here, model, state.params.degree)
    steps = state.step_fraction[None] * direction
    return steps, predicted, step_times(Times(state.params.time_loc, state.params.time_scale), steps)


@_over_restarts
def _m_step_with_times(
    model: Model, state: State, here: SufficientStatistics, there: SufficientStatistics, steps, predicted
) -> tuple[State, Info]:
    params = state.params
    before = profile_log_likelihood(here, model, params.degree, jnp.zeros_like(steps), here.gram[0], here.log_a[0])
    after = profile_log_likelihood(here, model, params.degree, steps, there.gram[0], there.log_a[0])
    rises = after >= before + _ARMIJO * state.step_fraction * predicted  # false for NaN
    gram = jnp.where(rises[:, None, None], there.gram[0], here.gram[0])
    new, stuck = update_components(params, here._replace(gram=gram[None]), model, jnp.where(rises[None], steps, 0))
    step_fraction = jnp.where(rises, jnp.minimum(1, 2 * state.step_fraction), 0.25 * state.step_fraction)
    rejected = jnp.where(rises, 0, predicted).sum()
    return State(new, step_fraction), Info(here.log_likelihood, here.mass, stuck, rejected)


def log_likelihood(params: Parameters, points: Points | Blocks, envelope: AbstractEnvelope) -> Float[Array, ""]:
    """sum_i w_i log p(x_i)."""
    return sum_over_points(accumulate, points, params, envelope).log_likelihood


def run_em(
    starts: Parameters,
    points: Points | Blocks,
    envelope: AbstractEnvelope,
    model: Model,
    *,
    total: float,
    least_mass: float = 0.0,
    tol: float = 1e-3,
    max_steps: int = 100,
    annealing: float = 1.0,
    observe=None,
) -> list[Run]:
    """Run EM from every start (leading axis) at once; `total` is the sum of weights.

    A component with less mass than `least_mass` is reset to half of the heaviest one, at most as often as there are
    components. A run has converged when the mean log-likelihood changes by less than `tol`, at temperature 1 (for at
    least `SETTLING_STEPS` steps if annealed), without a reset, and with no larger predicted gain rejected.
    """
    first_end = 1 if annealing == 1.0 else ANNEALING_STEPS + SETTLING_STEPS
    states, restarts = State(starts, jnp.ones_like(starts.time_loc)), len(starts.time_loc)
    before, lasts = states, np.full(restarts, np.nan)
    statuses = np.full(restarts, EMStatus.NOT_CONVERGED)
    done, resets, histories = np.zeros(restarts, bool), np.zeros(restarts, int), [[] for _ in range(restarts)]
    for number in range(1, max_steps + 1):
        inverse_temperature = annealing ** max(1 - (number - 1) / ANNEALING_STEPS, 0)
        annealed = inverse_temperature == 1.0
        beta = None if annealed else jnp.asarray(inverse_temperature, starts.time_loc.dtype)
        new, info = step(states, points, envelope, model, beta)
        values, rejected = np.asarray(info.log_likelihood) / total, np.asarray(info.rejected) / total
        broken = ~done & ~np.isfinite(values)
        changes = np.abs(np.where(np.isfinite(values), values, np.nan) - lasts)
        small = (changes < tol) & (rejected < max(tol, 1e-12)) & (number >= first_end)
        lasts, running = np.where(done, lasts, values), ~done
        for r in np.flatnonzero(running):
            histories[r].append(float(values[r]))
        statuses[broken] = EMStatus.NOT_FINITE
        if not annealed:
            new = _jitter(new, number)
        if (done | broken).any():  # a broken run goes back to the last parameters with a finite likelihood
            new = _select_restarts(done, states, _select_restarts(broken, before, new))
        empty = running[:, None] & ~broken[:, None] & (np.asarray(info.mass) < least_mass)
        reset = empty.any(1) & (resets < empty.shape[1]) & (number < max_steps)
        for r in np.flatnonzero(reset):
            new = _reset_components(new, r, empty[r], np.asarray(info.mass[r]))
            resets[r] += int(empty[r].sum())
        converged = running & ~broken & small & ~reset
        singular = (np.asarray(info.stuck) & (np.asarray(info.mass) > 0)).any(1)
        statuses[converged] = np.where(singular, EMStatus.SINGULAR, EMStatus.CONVERGED)[converged]
        done = done | broken | converged
        before, states = states, new
        if observe is not None:
            observe(number, values)
        if done.all():
            break
    params = [jax.tree.map(lambda z, r=r: z[r], states.params) for r in range(restarts)]
    return [Run(params[r], histories[r], EMStatus(int(statuses[r]))) for r in range(restarts)]


def select_best(runs: list[Run]) -> Run:
    """The run of the largest likelihood, the first of those equal up to rounding; a broken one only if all are.

    Without this tolerance the order of summation would choose among runs that reach the same optimum.
    """
    top = max(runs, key=_rank)
    rounding = _ROUNDING * float(jnp.finfo(top.params.curve.dtype).eps) * max(1.0, abs(top.log_likelihood))
    least = top.status != EMStatus.NOT_FINITE, top.log_likelihood - rounding
    return next((run for run in runs if _rank(run) >= least), top)


def _rank(run: Run) -> tuple[bool, float]:
    return run.status != EMStatus.NOT_FINITE, run.log_likelihood


@jax.jit
def _select_restarts(flags: Bool[Array, " restarts"], these: State, others: State) -> State:
    """`these` for restarts whose flag is true, else `others`."""
    return jax.vmap(lambda flag, *two: jax.tree.map(lambda a, b: jnp.where(flag, a, b), *two))(flags, these, others)


def _jitter(states: State, number: int) -> State:
    """Perturb the centers: components that coincide would otherwise stay together, as EM updates them alike.

    **Source:** Rose 1998, Deterministic annealing for clustering, compression, classification, regression.
    """
    params = states.params
    noise = _JITTER * make_generator(Stream.EM_JITTER, number).normal(size=params.curve[:, :, 0].shape)
    shift = jnp.einsum("rkab,rkb->rka", params.tril, jnp.asarray(noise, params.curve.dtype))
    return states._replace(params=params._replace(curve=params.curve.at[:, :, 0].add(shift)))


def _reset_components(states: State, restart: int, empty: np.ndarray, mass: np.ndarray) -> State:
    """Replace each empty component by half of the heaviest one; both are shifted apart along its longest axis."""
    log_weights, time_loc, time_scale, curve, tril = (np.array(z) for z in states.params)
    mass = np.where(empty, 0, mass)
    for k in np.flatnonzero(empty):
        donor = int(np.argmax(mass))
        for z in (time_loc, time_scale, curve, tril):
            z[restart, k] = z[restart, donor]
        axis = np.linalg.svd(tril[restart, donor])
        apart = 0.5 * axis[0][:, 0] * axis[1][0]
        curve[restart, donor, 0] += apart
        curve[restart, k, 0] -= apart
        half = log_weights[restart, donor] - np.log(2)
        log_weights[restart, [donor, k]] = half
        mass[[donor, k]] = mass[donor] / 2
    params = Parameters(*(jnp.asarray(z) for z in (log_weights, time_loc, time_scale, curve, tril)))
    return states._replace(params=params)
