"""The EM iteration, for several restarts at once: convergence, annealing, resets of empty components.

**Source:** Dempster, Laird and Rubin 1977; generalized EM where the envelope depends on time.
"""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

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
    step_times,
    sum_over_points,
)

__all__ = ["EMStatus", "Run", "State", "broadcast_degrees", "log_likelihood", "run_em", "select_best", "step"]

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
    log_likelihood: float
    history: list[float]
    num_steps: int
    status: EMStatus
    num_resets: int


def step(
    state: State, points: Points, envelope: AbstractEnvelope, model: Model, inverse_temperature=None
) -> tuple[State, Info]:
    """One iteration: exact EM for a constant envelope, else generalized EM with an ascent step of the times."""
    params = state.params
    if isinstance(envelope, Constant):
        return _m_step(state, accumulate(params, envelope, points, inverse_temperature=inverse_temperature), model)
    here = accumulate(params, envelope, points, order=2, inverse_temperature=inverse_temperature)
    proposal = _propose_times(state, here, model)
    there = accumulate(params, envelope, points, times=proposal.times, inverse_temperature=inverse_temperature)
    return _m_step_with_times(state, here, proposal, there, model)


class _TimeProposal(NamedTuple):
    """A proposed step of the times."""

    steps: Float[Array, "2 k"]
    predicted: Float[Array, " k"]
    times: Times


def _m_step(state: State, sums: SufficientStatistics, model: Model) -> tuple[State, Info]:
    new, stuck = update_components(state.params, sums, model)
    return State(new, state.step_fraction), Info(sums.log_likelihood, sums.mass, stuck, jnp.zeros((), sums.mass.dtype))


def _propose_times(state: State, here: SufficientStatistics, model: Model) -> _TimeProposal:
    direction, predicted = newton_step(here, model, state.params.degree)
    steps = state.step_fraction[None] * direction
    return _TimeProposal(steps, predicted, step_times(Times(state.params.time_loc, state.params.time_scale), steps))


def _m_step_with_times(
    state: State, here: SufficientStatistics, proposal: _TimeProposal, there: SufficientStatistics, model: Model
) -> tuple[State, Info]:
    (steps, predicted, _), params = proposal, state.params
    before = profile_log_likelihood(here, model, params.degree, jnp.zeros_like(steps), here.gram[0], here.log_a[0])
    after = profile_log_likelihood(here, model, params.degree, steps, there.gram[0], there.log_a[0])
    rises = after >= before + _ARMIJO * state.step_fraction * predicted  # false for NaN
    gram = jnp.where(rises[:, None, None], there.gram[0], here.gram[0])
    new, stuck = update_components(params, here._replace(gram=gram[None]), model, jnp.where(rises[None], steps, 0))
    step_fraction = jnp.where(rises, jnp.minimum(1, 2 * state.step_fraction), 0.25 * state.step_fraction)
    rejected = jnp.where(rises, 0, predicted).sum()
    return State(new, step_fraction), Info(here.log_likelihood, here.mass, stuck, rejected)


@eqx.filter_jit
def _step_restarts(states: State, frozen, points, envelope, model, inverse_temperature):
    """Step every restart except frozen ones."""

    def one(state, frozen):
        return _freeze(frozen, state, *step(state, points, envelope, model, inverse_temperature))

    return _map_restarts(one, states, frozen)


def _freeze(frozen, state: State, new: State, info: Info) -> tuple[State, Info]:
    return jax.tree.map(lambda a, b: jnp.where(frozen, a, b), state, new), info


def _map_restarts(function, *arguments):
    """Apply a function to each restart (leading axis)."""
    if len(jax.tree.leaves(arguments)[0]) == 1:  # avoids an axis of size one in every array
        return jax.tree.map(lambda z: z[None], function(*jax.tree.map(lambda z: z[0], arguments)))
    return jax.vmap(function)(*arguments)


# --- the same step over blocks: the sums are one program, called for each block, the M-step another ----------------


def _step_over_blocks(states: State, frozen, blocks: Blocks, envelope, model, inverse_temperature):
    """As `_step_restarts`, for points that are read block by block."""
    if isinstance(envelope, Constant):
        sums = sum_over_points(_accumulate_restarts, blocks, states.params, envelope, None, 0, inverse_temperature)
        return _m_step_each(states, frozen, sums, model)
    here = sum_over_points(_accumulate_restarts, blocks, states.params, envelope, None, 2, inverse_temperature)
    proposal = _propose_times_each(states, here, model)
    there = sum_over_points(
        _accumulate_restarts, blocks, states.params, envelope, proposal.times, 0, inverse_temperature
    )
    return _m_step_with_times_each(states, frozen, here, proposal, there, model)


def _accumulate_restarts(
    params: Parameters, envelope, times: Times | None, order: int, inverse_temperature, points: Points
):
    def one(params, times):
        return accumulate(params, envelope, points, times=times, order=order, inverse_temperature=inverse_temperature)

    return _map_restarts(one, params, times)


@eqx.filter_jit
def _m_step_each(states, frozen, sums, model):
    def one(frozen, state, sums):
        return _freeze(frozen, state, *_m_step(state, sums, model))

    return _map_restarts(one, frozen, states, sums)


@eqx.filter_jit
def _propose_times_each(states, here, model):
    return _map_restarts(lambda state, here: _propose_times(state, here, model), states, here)


@eqx.filter_jit
def _m_step_with_times_each(states, frozen, here, proposal, there, model):
    def one(frozen, state, *sums):
        return _freeze(frozen, state, *_m_step_with_times(state, *sums, model))

    return _map_restarts(one, frozen, states, here, proposal, there)


def log_likelihood(params: Parameters, points: Points | Blocks, envelope: AbstractEnvelope) -> Float[Array, ""]:
    """sum_i w_i log p(x_i)."""
    return sum_over_points(_log_likelihood, points, params, envelope)


def _log_likelihood(params: Parameters, envelope: AbstractEnvelope, points: Points) -> Float[Array, ""]:
    return accumulate(params, envelope, points).log_likelihood


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
    last: float = -np.inf,
    observe=None,
) -> list[Run]:
    """Run EM from every start (leading axis) in one program, or one for each block; `total` is the sum of weights, and
    `last` the mean log-likelihood before the start, if a run is continued.

    A component with less mass than `least_mass` is reset to half of the heaviest one, at most as often as there are
    components. A run has converged when the mean log-likelihood changes by less than `tol`, at temperature 1 (for at
    least `SETTLING_STEPS` steps if annealed), without a reset, and with no larger predicted gain rejected.
    """
    first_end = 1 if annealing == 1.0 else ANNEALING_STEPS + SETTLING_STEPS
    states, restarts = State(starts, jnp.ones_like(starts.time_loc)), len(starts.time_loc)
    step_all = _step_over_blocks if isinstance(points, Blocks) else _step_restarts
    before, lasts = states, np.full(restarts, last)
    statuses = np.full(restarts, EMStatus.NOT_CONVERGED)
    done, num_steps = np.zeros(restarts, bool), np.zeros(restarts, int)
    resets, histories = np.zeros(restarts, int), [[] for _ in range(restarts)]
    for number in range(1, max_steps + 1):
        inverse_temperature = annealing ** max(1 - (number - 1) / ANNEALING_STEPS, 0)
        annealed = inverse_temperature == 1.0
        beta = None if annealed else jnp.asarray(inverse_temperature, starts.time_loc.dtype)
        new, info = step_all(states, jnp.asarray(done), points, envelope, model, beta)
        values, rejected = np.asarray(info.log_likelihood) / total, np.asarray(info.rejected) / total
        broken = ~done & ~np.isfinite(values)
        small = (np.abs(values - lasts) < tol) & (rejected < max(tol, 1e-12)) & (number >= first_end)
        lasts, running = np.where(done, lasts, values), ~done
        for r in np.flatnonzero(running):
            histories[r].append(float(values[r]))
        num_steps[running] = number
        statuses[broken] = EMStatus.NOT_FINITE
        if not annealed:
            new = _jitter(new, number)
        if broken.any():  # back to the last parameters with a finite likelihood
            new = _select_restarts(broken, before, new)
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
    return [
        Run(
            jax.tree.map(lambda z, r=r: z[r], states.params),
            _last_finite(histories[r]),
            histories[r],
            int(num_steps[r]),
            EMStatus(int(statuses[r])),
            int(resets[r]),
        )
        for r in range(restarts)
    ]


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


def _last_finite(history: list[float]) -> float:
    return next((value for value in reversed(history) if np.isfinite(value)), -np.inf)


def _select_restarts(flags: np.ndarray, these: State, others: State) -> State:
    """`these` for restarts whose flag is true, else `others`."""
    choose = lambda a, b: jnp.where(jnp.asarray(flags).reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
    return jax.tree.map(choose, these, others)


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


def broadcast_degrees(degrees, num_components: int) -> Int[Array, " k"]:
    """One degree for all components, or one for each."""
    return jnp.broadcast_to(jnp.asarray(degrees, jnp.int32), (num_components,))
