"""Taking stock in a running fit: what does not pay goes, what does is born, and what serves many is shared."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32

from foldgauss.render import cpu, pixels_per_unit
from foldgauss.video.fitting.codebook import Codebook, averaged, shared
from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, most_gaussians
from foldgauss.video.fitting.growth import GradientStatistics
from foldgauss.video.fitting.initialize import START_OPACITY
from foldgauss.video.fitting.optical_flow import Motion
from foldgauss.video.fitting.pruning.births import among, newborns
from foldgauss.video.fitting.pruning.description_length import Cut, allowed_error, count_births, cut, frame_weights
from foldgauss.video.fitting.pruning.scores import PruningScores, measured
from foldgauss.video.fitting.state import FitState, envelope_of, frame_times, mean_psnr, planar
from foldgauss.video.models.background import random_background
from foldgauss.video.models.conditioning import ConditioningSpec, condition, update_windows
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.sparse_storage import clear_absent_moments, count_parameters, find_initial_kinds

#: Gaussians born in all are so many times those at the start at most.
MOST_BORN = 4
#: Times that a fit is trimmed at its end, and the share of its numbers that is worth another time.
TRIMS, LEAST_TRIM = 8, 0.002
#: Rounds that are left when colours and shapes are shared and opacities left out, in plans with enough: they see what
#: that costs.
LATE = 1
#: Of the squared error, what sharing colours, and sharing shapes, may add before it is mended.
MOST_BY_SHARING = 0.25


class Pruner:
    """What a fit with an economy does between its steps. All of it changes the state in place."""

    def __init__(
        self,
        frames: np.ndarray,
        config: FitConfig,
        shape: ConditioningSpec,
        coarse: float,
        motion: Callable[[], Motion],
    ):
        """`shape` is that of whole frames, `coarse` the share of the plan with smaller ones."""
        self._frames, self._config, self._shape, self._coarse, self._motion = frames, config, shape, coarse, motion

    def take(self, state: FitState) -> bool:
        """Take stock where that is due: drop what does not pay, bear where it does, share. Whether it was due."""
        config, economy = self._config, self._config.economy
        steps = self._rounds(state.plan)
        if state.step not in steps:
            return False
        growing = state.step in steps[: len(steps) // 2]
        ledger, progress = self._ledger(state), state.step / state.plan
        psnr = self._psnr(state, ledger)
        room, late = allowed_error(economy, ledger, psnr, progress), steps[max(len(steps) // 2, len(steps) - 1 - LATE)]
        made = self._cut(state, ledger, room, solid=state.step >= late)
        survived = state.young[made.stay].sum() / max(state.young.sum(), 1) if state.step > steps[0] else 1.0
        _keep(state, made, config.degree)
        if state.step == late and not growing and state.statistics is None:  # those to be born have their own
            self._share(state, ledger, made)
        num = 0
        if growing:
            at_start = chosen_num_gaussians(config, *self._frames.shape[:3])
            most = min(most_gaussians(config, len(self._frames)), MOST_BORN * at_start)
            num = min(count_births(economy, ledger, psnr, progress, len(state.rows), survived), most - len(state.rows))
        state.young = np.zeros(len(state.rows), bool)
        if num > 0:
            self._bear(state, ledger, num)
        if state.statistics is not None:
            state.statistics = GradientStatistics.zeros(len(state.rows))
        return True

    def trim(self, state: FitState) -> None:
        """At the end: leave out what the PSNR asked for has no need of, each try measured, until none succeeds."""
        for _ in range(TRIMS):
            if not self._trimmed(state):
                break

    def _rounds(self, plan: int) -> np.ndarray:
        """The steps after which stock is taken."""
        coarse, config = self._coarse, self._config
        if config.growth is not None:
            coarse = max(coarse, config.growth.for_plan(plan).until_step / plan)
        return config.economy.steps(plan, passes=plan * config.batch_size / len(self._frames), coarse=coarse)

    def _trimmed(self, state: FitState) -> bool:
        config, ledger = self._config, self._ledger(state)
        wanted, size = config.economy.psnr, count_parameters(state.kinds)
        room = ledger.squared_error * (10 ** (max(self._psnr(state, ledger) - wanted, 0.0) / 10) - 1)
        for share in (1.5, 1.0, 0.8, 0.6, 0.4, 0.2):
            tried = dataclasses.replace(state)
            _keep(tried, self._cut(tried, ledger, share * room), config.degree)
            fewer = count_parameters(tried.kinds) < (1 - LEAST_TRIM) * size
            if fewer and mean_psnr(tried, config, self._frames) >= wanted:
                for field in dataclasses.fields(state):
                    setattr(state, field.name, getattr(tried, field.name))
                return True
        return False

    def _cut(self, state: FitState, ledger: PruningScores, room: float | None, *, solid: bool = True) -> Cut:
        how = {"degree": self._config.degree, "pixels": pixels_per_unit(self._shape.size), "room": room}
        how |= {"progress": min(state.step / state.plan, 1.0), "sized": len(state.shapes.index) > 0}
        # Growth dims; and whom no light comes through early hides for good what others might become.
        how |= {"solid": solid and state.statistics is None}
        return cut(state.rows, state.kinds, ledger, self._config.economy, **how)

    # ------------------------------------------------------------------------------------------ births

    def _bear(self, state: FitState, ledger: PruningScores, num: int) -> None:
        """Gaussians where the error is, in depth anywhere between the others."""
        config, times = self._config, np.asarray(frame_times(state.time_logits))
        window = _windows(state.rows)
        new = newborns(
            num,
            np.ascontiguousarray(self._frames[..., :3]),
            times,
            ledger.errors,
            lambda k: self._squares(state.rows, window, k, times[k]),
            float(np.mean([((window[:, 0] < t) & (t < window[:, 1])).sum() for t in times])),
            degree=config.degree,
            envelope=envelope_of(config),
            motion=self._motion() if config.follow_motion else None,
            opacity=START_OPACITY,
            seed=(config.seed, 3, state.step),
        )
        order = among(len(state.rows), num, np.random.default_rng([config.seed, 6, state.step]))
        state.rows = np.concatenate([state.rows, new])[order]
        for name in ("first", "second"):
            setattr(state, name, np.concatenate([getattr(state, name), np.zeros_like(new)])[order])
        state.counts = np.concatenate([state.counts, np.zeros(num, np.int32)])[order]
        state.young = np.concatenate([state.young, np.ones(num, bool)])[order]
        state.kinds = np.concatenate([state.kinds, find_initial_kinds(new, config.degree)])[order]

    def _squares(self, rows: np.ndarray, window: np.ndarray, k: int, t: float) -> Float32[np.ndarray, "height width"]:
        """Squared errors of frame k, summed over the channels."""
        target, behind = self._target(k)
        done = condition(rows, window, t, self._shape)
        leaves = done.mean, done.factor, done.opacity, done.color, behind
        return ((cpu.forward(*leaves, self._shape.size, **self._drawn()).image - target) ** 2).sum(0)

    # ------------------------------------------------------------------------------------------ what is shared

    def _share(self, state: FitState, ledger: PruningScores, made: Cut) -> None:
        """Colours and shapes of those that stayed, each where that pays."""
        degree, stay = self._config.degree, made.stay
        turned = _long_axis_first(state, degree)
        of_axes = np.where(turned[:, None], ledger.by_axes[stay, ::-1], ledger.by_axes[stay])
        of_colors = np.repeat(ledger.by_color[stay, None], 3, axis=1)
        for leaf, name, weight in (("color_dc", "colors", of_colors), ("log_scale", "shapes", of_axes)):
            at, progress = columns(degree)[leaf], min(state.step / state.plan, 1.0)
            how = {"progress": progress, "most": MOST_BY_SHARING * ledger.squared_error}
            index = shared(state.rows[:, at], weight, made.price, self._config.seed, **how)
            setattr(state, name, Codebook.of(index, weight.shape[1]))
            if index is not None:
                state.rows[:, at] = averaged(state.rows[:, at], index)
                state.first[:, at] = state.second[:, at] = 0

    # ------------------------------------------------------------------------------------------ what is measured

    def _ledger(self, state: FitState) -> PruningScores:
        times = np.asarray(frame_times(state.time_logits))
        weights = None if self._config.economy.psnr is None else frame_weights(state.frame_errors)
        how = self._drawn() | {"seed": state.step, "weights": weights}
        return measured(state.rows, _windows(state.rows), times, self._shape, self._target, **how)

    def _psnr(self, state: FitState, ledger: PruningScores) -> float:
        """dB, as the fit is held to it: frames with alpha are shown over black, and measured over other colours."""
        alpha = self._frames.shape[3] == 4 and self._config.economy.psnr is not None
        return mean_psnr(state, self._config, self._frames) if alpha else ledger.psnr

    def _target(self, k: int) -> tuple[Float32[np.ndarray, "3 height width"], Float[np.ndarray, "3"]]:
        """Frame k, whole; with alpha over one colour for good, which is told too."""
        alpha = self._frames.shape[3] == 4
        behind = random_background(self._config.seed, k) if alpha else np.zeros(3, np.float32)
        return planar(self._frames[k], behind), behind

    def _drawn(self) -> dict:
        return {"compositing": self._config.compositing, "options": self._config.options}


def _windows(rows: np.ndarray) -> Float32[np.ndarray, "num 2"]:
    window = np.empty((len(rows), 2), np.float32)
    update_windows(rows, np.arange(len(rows)), window)
    return window


def _keep(state: FitState, made: Cut, degree: int) -> None:
    """The state with what is left."""
    state.rows, state.kinds = made.rows, made.kinds
    for name in ("first", "second", "counts", "young"):
        setattr(state, name, getattr(state, name)[made.stay])
    state.colors, state.shapes = state.colors.kept(made.stay), state.shapes.kept(made.stay)
    clear_absent_moments(state.first, state.second, state.kinds, degree)


def _long_axis_first(state: FitState, degree: int) -> np.ndarray:
    """Turn Gaussians by a quarter where the second axis is longer: alike are then alike in numbers. Returns where."""
    at = columns(degree)
    first, second = at["log_scale"].start, at["log_scale"].start + 1
    turned = state.rows[:, first] < state.rows[:, second]
    for array in (state.rows, state.first, state.second):
        array[turned, first], array[turned, second] = array[turned, second], array[turned, first]
    turn = 1 / (1 + np.exp(-state.rows[turned, at["angle_logit"].start].astype(float)))
    turn += np.where(turn < 0.5, 0.25, -0.25)
    state.rows[turned, at["angle_logit"].start] = np.log(turn / (1 - turn))
    return turned
