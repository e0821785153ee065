"""Expectation maximisation: the loop. What a step does stands in `statistics` and `updates`.

**Source:** Dempster, Laird and Rubin 1977; generalised EM where the envelope hangs on time.
"""

from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from foldgauss.envelope import AbstractEnvelope, Constant
from foldgauss.estimator.em.components import Parameters
from foldgauss.estimator.em.statistics import Blocks, Points, Statistics, Times, accumulate, summed, time_steps
from foldgauss.estimator.em.updates import Model, newton_step, profile, updated

__all__ = ["EMStatus", "Run", "State", "best", "expectation_maximisation", "log_likelihood", "step", "used_degrees"]

#: Of what a step of time promises, the share that it must bring.
_ARMIJO = 1e-4
#: Steps from the first inverse temperature to 1.
ANNEALING_STEPS = 50
#: Mean log-likelihoods that differ by less than so many times their dtype's eps are equal.
_ROUNDING = 64
#: On the way, centres are moved by this share of their own spread: components that heat has made one can part again.
_JITTER = 0.05


class EMStatus(IntEnum):
    """How a run ended. Only CONVERGED is convergence."""

    CONVERGED = 0
    NOT_CONVERGED = 1
    NOT_FINITE = 2
    SINGULAR = 3


class State(NamedTuple):
    params: Parameters
    share: Float[Array, " k"]  # of Newton's step of time; smaller after a step that did not go up


class Info(NamedTuple):
    """About one step: of the parameters it began with."""

    log_likelihood: Float[Array, ""]
    mass: Float[Array, " k"]
    stuck: Bool[Array, " k"]  # no update was possible
    refused: Float[Array, ""]  # what steps of time promised and did not bring


class Run(NamedTuple):
    """One restart's end: the last parameters, and the mean log-likelihood before each of its steps."""

    params: Parameters
    log_likelihood: float
    history: list[float]
    num_steps: int
    status: EMStatus
    num_resets: int


def step(
    state: State, points: Points, envelope: AbstractEnvelope, model: Model, inverse_temperature=None
) -> tuple[State, Info]:
    """One iteration: exact EM for a constant envelope, else generalised EM with a step of time that goes up."""
    params = state.params
    if isinstance(envelope, Constant):
        return _stepped(state, accumulate(params, envelope, points, inverse_temperature=inverse_temperature), model)
    here = accumulate(params, envelope, points, order=2, inverse_temperature=inverse_temperature)
    trial = _trial(state, here, model)
    there = accumulate(params, envelope, points, times=trial.times, inverse_temperature=inverse_temperature)
    return _stepped_in_time(state, here, trial, there, model)


class _Trial(NamedTuple):
    """A step of time that is to be tried."""

    steps: Float[Array, "2 k"]
    promise: Float[Array, " k"]
    times: Times


def _stepped(state: State, sums: Statistics, model: Model) -> tuple[State, Info]:
    new, stuck = updated(state.params, sums, model)
    return State(new, state.share), Info(sums.log_likelihood, sums.mass, stuck, jnp.zeros((), sums.mass.dtype))


def _trial(state: State, here: Statistics, model: Model) -> _Trial:
    direction, promise = newton_step(here, model, state.params.degree)
    steps = state.share[None] * direction
    return _Trial(steps, promise, time_steps(Times(state.params.time_loc, state.params.time_scale), steps))


def _stepped_in_time(
    state: State, here: Statistics, trial: _Trial, there: Statistics, model: Model
) -> tuple[State, Info]:
    (steps, promise, _), params = trial, state.params
    before = profile(here, model, params.degree, jnp.zeros_like(steps), here.gram[0], here.log_a[0])
    after = profile(here, model, params.degree, steps, there.gram[0], there.log_a[0])
    rises = after >= before + _ARMIJO * state.share * promise  # so written, a NaN does not rise
    gram = jnp.where(rises[:, None, None], there.gram[0], here.gram[0])
    new, stuck = updated(params, here._replace(gram=gram[None]), model, jnp.where(rises[None], steps, 0))
    share = jnp.where(rises, jnp.minimum(1, 2 * state.share), 0.25 * state.share)
    refused = jnp.where(rises, 0, promise).sum()
    return State(new, share), Info(here.log_likelihood, here.mass, stuck, refused)


@eqx.filter_jit
def _steps(states: State, frozen, points, envelope, model, inverse_temperature):
    """A step of every restart; frozen ones stay."""

    def one(state, stays):
        return _held(stays, state, *step(state, points, envelope, model, inverse_temperature))

    return _of_each(one, states, frozen)


def _held(stays, state: State, new: State, info: Info) -> tuple[State, Info]:
    return jax.tree.map(lambda a, b: jnp.where(stays, a, b), state, new), info


def _of_each(function, *arguments):
    """The function of each restart (leading axis)."""
    if len(jax.tree.leaves(arguments)[0]) == 1:  # without an axis of size one in every array
        return jax.tree.map(lambda z: z[None], function(*jax.tree.map(lambda z: z[0], arguments)))
    return jax.vmap(function)(*arguments)


# --- the same step over blocks: the sums are one program, called for each block, what is made of them another ------


def _steps_of_blocks(states: State, frozen, blocks: Blocks, envelope, model, inverse_temperature):
    """As `_steps`."""
    if isinstance(envelope, Constant):
        sums = summed(_sums, blocks, states.params, envelope, None, 0, inverse_temperature)
        return _stepped_each(states, frozen, sums, model)
    here = summed(_sums, blocks, states.params, envelope, None, 2, inverse_temperature)
    trial = _trial_each(states, here, model)
    there = summed(_sums, blocks, states.params, envelope, trial.times, 0, inverse_temperature)
    return _stepped_in_time_each(states, frozen, here, trial, there, model)


def _sums(params: Parameters, envelope, times: Times | None, order: int, inverse_temperature, points: Points):
    def one(params, times):
        return accumulate(params, envelope, points, times=times, order=order, inverse_temperature=inverse_temperature)

    return _of_each(one, params, times)


@eqx.filter_jit
def _stepped_each(states, frozen, sums, model):
    return _of_each(lambda stays, state, sums: _held(stays, state, *_stepped(state, sums, model)), frozen, states, sums)


@eqx.filter_jit
def _trial_each(states, here, model):
    return _of_each(lambda state, here: _trial(state, here, model), states, here)


@eqx.filter_jit
def _stepped_in_time_each(states, frozen, here, trial, there, model):
    def one(stays, state, *sums):
        return _held(stays, state, *_stepped_in_time(state, *sums, model))

    return _of_each(one, frozen, states, here, trial, there)


def log_likelihood(params: Parameters, points: Points | Blocks, envelope: AbstractEnvelope) -> Float[Array, ""]:
    """sum_i w_i log p(x_i)."""
    return summed(_log_likelihood, points, params, envelope)


def _log_likelihood(params: Parameters, envelope: AbstractEnvelope, points: Points) -> Float[Array, ""]:
    return accumulate(params, envelope, points).log_likelihood


def expectation_maximisation(
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
    """EM from every start (leading axis), all in one program, or in one for each block; `total` is the weights' sum.

    A component with less mass than `least_mass` is given half of the heaviest one instead, so many times as there are
    components. A run converges where the mean log-likelihood moves by less than `tol`, at temperature 1, without a
    reset, and with no larger promise refused to its times.
    """
    states, restarts = State(starts, jnp.ones_like(starts.time_loc)), len(starts.time_loc)
    take_steps = _steps_of_blocks if isinstance(points, Blocks) else _steps
    before, lasts = states, np.full(restarts, -np.inf)
    statuses = np.full(restarts, EMStatus.NOT_CONVERGED)
    done, num_steps = np.zeros(restarts, bool), np.zeros(restarts, int)
    resets, histories = np.zeros(restarts, int), [[] for _ in range(restarts)]
    for number in range(1, max_steps + 1):
        heat = annealing ** max(1 - (number - 1) / ANNEALING_STEPS, 0)
        cold = heat == 1.0
        temperature = None if cold else jnp.asarray(heat, starts.time_loc.dtype)
        new, info = take_steps(states, jnp.asarray(done), points, envelope, model, temperature)
        values, refused = np.asarray(info.log_likelihood) / total, np.asarray(info.refused) / total
        broken = ~done & ~np.isfinite(values)
        small = (np.abs(values - lasts) < tol) & (refused < max(tol, 1e-12)) & cold & (number > 1)
        lasts, going = np.where(done, lasts, values), ~done
        for r in np.flatnonzero(going):
            histories[r].append(float(values[r]))
        num_steps[going] = number
        statuses[broken] = EMStatus.NOT_FINITE
        if not cold:
            new = _jittered(new, number)
        if broken.any():  # back to the last parameters whose likelihood was a number
            new = _chosen(broken, before, new)
        dead = going[:, None] & ~broken[:, None] & (np.asarray(info.mass) < least_mass)
        reset = dead.any(1) & (resets < dead.shape[1]) & (number < max_steps)
        for r in np.flatnonzero(reset):
            new = _reset(new, r, dead[r], np.asarray(info.mass[r]))
            resets[r] += int(dead[r].sum())
        converged = going & ~broken & small & ~reset
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


def best(runs: list[Run]) -> Run:
    """The run of the largest likelihood, the first of those equal up to rounding; a broken one only if all are.

    Otherwise the order in which points are summed would choose among starts that lead to one end.
    """
    top = max(runs, key=_goodness)
    rounding = _ROUNDING * float(jnp.finfo(top.params.curve.dtype).eps) * max(1.0, abs(top.log_likelihood))
    sound, least = top.status != EMStatus.NOT_FINITE, top.log_likelihood - rounding
    return next((run for run in runs if _goodness(run) >= (sound, least)), top)


def _goodness(run: Run) -> tuple[bool, float]:
    return run.status != EMStatus.NOT_FINITE, run.log_likelihood


def _last_finite(history: list[float]) -> float:
    return next((value for value in reversed(history) if np.isfinite(value)), -np.inf)


def _chosen(flags: np.ndarray, these: State, others: State) -> State:
    """These where the restart's flag is true."""
    choose = lambda a, b: jnp.where(jnp.asarray(flags).reshape(-1, *[1] * (a.ndim - 1)), a, b)  # noqa: E731
    return jax.tree.map(choose, these, others)


def _jittered(states: State, number: int) -> State:
    """Components that lie on each other stay there: EM moves them as one.

    **Source:** Rose 1998, Deterministic annealing for clustering, compression, classification, regression.
    """
    params = states.params
    noise = jnp.asarray(
        _JITTER * np.random.default_rng(number).normal(size=params.curve[:, :, 0].shape), params.curve.dtype
    )
    return State(
        params._replace(curve=params.curve.at[:, :, 0].add(jnp.einsum("rkab,rkb->rka", params.tril, noise))),
        states.share,
    )


def _reset(states: State, restart: int, dead: np.ndarray, mass: np.ndarray) -> State:
    """Each dead component takes half of the heaviest one, both a little apart along its longest axis."""
    log_weights, time_loc, time_scale, curve, tril = (np.array(z) for z in states.params)
    mass = np.where(dead, 0, mass)
    for k in np.flatnonzero(dead):
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
    return State(params, states.share)


def used_degrees(degrees, num_components: int) -> Int[Array, " k"]:
    """One degree for all, or one for each."""
    return jnp.broadcast_to(jnp.asarray(degrees, jnp.int32), (num_components,))
