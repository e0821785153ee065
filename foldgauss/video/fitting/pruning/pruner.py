"""`Pruner`: the rounds of pruning of a fit with an `Economy`, in which Gaussians are pruned, born and share values."""

import dataclasses
from collections.abc import Callable

import numpy as np

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss.render import pixels_per_unit
from foldgauss.video.fitting.codebook import Codebook, average_clusters, find_clusters
from foldgauss.video.fitting.config import FitConfig, chosen_num_gaussians, most_gaussians
from foldgauss.video.fitting.pruning.births import make_newborns, make_target, shuffle_into
from foldgauss.video.fitting.pruning.description_length import (
    PrunedRows,
    allowed_error,
    count_births,
    prune_rows,
    weigh_frames,
)
from foldgauss.video.fitting.pruning.scores import PruningScores, measure_scores
from foldgauss.video.fitting.state import FitState, frame_times, mean_psnr, paths_of
from foldgauss.video.models.conditioning import ConditioningSpec, find_windows
from foldgauss.video.models.row_layout import columns
from foldgauss.video.models.sparse_storage import clear_absent_moments, count_parameters, find_initial_kinds
from foldgauss.video.motion.optical_flow import Motion

#: At most so many Gaussians are born in all, in units of those at the start.
MAX_BORN = 4
#: How often a fit is trimmed at its end, and the fraction of its parameters that is worth another time.
MAX_TRIMS, MIN_TRIM = 8, 0.002
#: A round is tried again with these fractions of what it would prune, where the mean PSNR falls by more than so many dB
#: below the target: the remaining Gaussians do not grow over a large region that nothing covers.
LESS, MAX_SHORTFALL = (0.5, 0.25, 0.1), 6.0
#: Colors and shapes are shared, and opacities left out, only so many rounds before the last, in plans that have them:
#: these correct for it.
LATE_ROUNDS = 1
#: What sharing colors, and sharing shapes, may add at first, as a fraction of the squared error.
MAX_SHARING_ERROR = 0.25


class Pruner:
    """Prunes between the steps of a fit; all methods change the state in place."""

    def __init__(
        self,
        frames: np.ndarray,
        config: FitConfig,
        spec: ConditioningSpec,
        coarse: float,
        find_motion: Callable[[], Motion],
    ):
        """`spec` is that of whole frames, `coarse` the fraction of the plan with smaller ones."""
        self._frames, self._config, self._spec, self._coarse = frames, config, spec, coarse
        self._find_motion = find_motion

    def prune(self, state: FitState) -> bool:
        """A round of pruning, births and sharing, each where it pays, if one is due; returns whether one was."""
        config, economy = self._config, self._config.economy
        steps = self._plan_rounds(state.plan)
        if state.step not in steps:
            return False
        growing = state.step in steps[: len(steps) // 2]
        scores, progress = self._measure(state), state.step / state.plan
        psnr = self._psnr(state, scores)
        max_added_error = allowed_error(economy, scores, psnr, progress)
        late = steps[max(len(steps) // 2, len(steps) - 1 - LATE_ROUNDS)]
        pruned = self._prune_rows(state, scores, max_added_error, allow_opaque=state.step >= late)
        for fraction in LESS:
            if not self._falls_far_below(state, pruned):
                break
            pruned = self._prune_rows(
                state, scores, max_added_error, allow_opaque=state.step >= late, fraction=fraction
            )
        survived = state.newborn[pruned.stay].sum() / max(state.newborn.sum(), 1) if state.step > steps[0] else 1.0
        _keep(state, pruned, config.degree)
        if state.step == late and not growing and state.statistics is None:  # newborn Gaussians share nothing
            self._share(state, scores, pruned)
        num = 0
        if growing:
            at_start = chosen_num_gaussians(config, *self._frames.shape[:3])
            most = min(most_gaussians(config, len(self._frames)), MAX_BORN * at_start)
            births = count_births(economy, scores, psnr, progress, len(state.rows), survived)
            num = min(births, most - len(state.rows))
        state.newborn = np.zeros(len(state.rows), bool)
        if num > 0:
            self._add_newborns(state, scores, num)
        return True

    def trim(self, state: FitState) -> None:
        """At the end, drop what the target PSNR does not need, measured at each attempt, until none succeeds."""
        for _ in range(MAX_TRIMS):
            if not self._trim_once(state):
                break

    def _plan_rounds(self, plan: int) -> np.ndarray:
        """The steps after which there is a round."""
        coarse, config = self._coarse, self._config
        if config.growth is not None:
            coarse = max(coarse, config.growth.for_plan(plan).until_step / plan)
        return config.economy.steps(plan, passes=plan * config.batch_size / len(self._frames), coarse=coarse)

    def _trim_once(self, state: FitState) -> bool:
        config, scores = self._config, self._measure(state)
        wanted, size = config.economy.psnr, count_parameters(state.kinds)
        max_added_error = scores.squared_error * (10 ** (max(self._psnr(state, scores) - wanted, 0.0) / 10) - 1)
        for fraction in (1.5, 1.0, 0.8, 0.6, 0.4, 0.2):
            trial = dataclasses.replace(state)
            _keep(trial, self._prune_rows(trial, scores, fraction * max_added_error), config.degree)
            fewer = count_parameters(trial.kinds) < (1 - MIN_TRIM) * size
            if fewer and mean_psnr(trial, config, self._frames) >= wanted:
                for field in dataclasses.fields(state):
                    setattr(state, field.name, getattr(trial, field.name))
                return True
        return False

    def _falls_far_below(self, state: FitState, pruned: PrunedRows) -> bool:
        """Whether the images after pruning are far below the target PSNR; never without one."""
        if self._config.economy.psnr is None:
            return False
        trial = dataclasses.replace(state)
        _keep(trial, pruned, self._config.degree)
        return mean_psnr(trial, self._config, self._frames) < self._config.economy.psnr - MAX_SHORTFALL

    def _prune_rows(
        self,
        state: FitState,
        scores: PruningScores,
        max_added_error: float | None,
        *,
        allow_opaque: bool = True,
        fraction: float = 1.0,
    ) -> PrunedRows:
        """What a round keeps; with a `fraction` of the error that it may add and of the Gaussians that it may drop."""
        economy = self._config.economy
        return prune_rows(
            state.rows,
            state.kinds,
            scores,
            dataclasses.replace(economy, most_dropped=fraction * economy.most_dropped),
            degree=self._config.degree,
            pixels=pixels_per_unit(self._spec.size),
            max_added_error=None if max_added_error is None else fraction * max_added_error,
            progress=min(state.step / state.plan, 1.0),
            shares_sizes=len(state.shapes.index) > 0,
            # Resets of opacity make none; and what is opaque early hides for good what others could become.
            allow_opaque=allow_opaque and state.statistics is None,
        )

    # ------------------------------------------------------------------------------------------ births

    def _add_newborns(self, state: FitState, scores: PruningScores, num: int) -> None:
        """Gaussians where errors are large, in depth anywhere between the others."""
        config = self._config
        motion = self._find_motion() if config.follow_motion else None
        new = make_newborns(num, state, self._frames, scores.errors, config, self._spec, motion, with_static=True)
        order = shuffle_into(len(state.rows), num, make_generator(Stream.BIRTH_DEPTH, state.step, seed=config.seed))
        state.extend(new, find_initial_kinds(new, config.degree), newborn=np.ones(num, bool))
        state.keep(order)

    # ------------------------------------------------------------------------------------------ sharing

    def _share(self, state: FitState, scores: PruningScores, pruned: PrunedRows) -> None:
        """Let the Gaussians that stayed share colors and shapes, each where that pays."""
        degree, stay = self._config.degree, pruned.stay
        turned = _long_axis_first(state, degree)
        of_axes = np.where(turned[:, None], scores.by_axes[stay, ::-1], scores.by_axes[stay])
        of_colors = np.repeat(scores.by_color[stay, None], 3, axis=1)
        progress, max_error = min(state.step / state.plan, 1.0), MAX_SHARING_ERROR * scores.squared_error
        for leaf, name, weight in (("color_dc", "colors", of_colors), ("log_scale", "shapes", of_axes)):
            at, seed = columns(degree)[leaf], self._config.seed
            index = find_clusters(state.rows[:, at], weight, pruned.price, seed, progress=progress, max_error=max_error)
            setattr(state, name, Codebook.create(index, weight.shape[1]))
            if index is not None:
                state.rows[:, at] = average_clusters(state.rows[:, at], index)
                state.first[:, at] = state.second[:, at] = 0

    # ------------------------------------------------------------------------------------------ measurements

    def _measure(self, state: FitState) -> PruningScores:
        times = np.asarray(frame_times(state.time_logits))
        weights = None if self._config.economy.psnr is None else weigh_frames(state.frame_errors)
        return measure_scores(
            state.rows,
            find_windows(state.rows, self._spec),
            times,
            dataclasses.replace(self._spec, paths=paths_of(state)),
            lambda k: make_target(self._frames, k, self._config),
            compositing=self._config.compositing,
            options=self._config.options,
            weights=weights,
            seed=state.step,
        )

    def _psnr(self, state: FitState, scores: PruningScores) -> float:
        """The mean PSNR in dB, over black; scores of frames with alpha are measured over other colors."""
        alpha = self._frames.shape[3] == 4 and self._config.economy.psnr is not None
        return mean_psnr(state, self._config, self._frames) if alpha else scores.psnr


def _keep(state: FitState, pruned: PrunedRows, degree: int) -> None:
    """Reduce the state to what stays after pruning."""
    state.keep(pruned.stay, rows=pruned.rows, kinds=pruned.kinds)
    clear_absent_moments(state.first, state.second, state.kinds, degree)


def _long_axis_first(state: FitState, degree: int) -> np.ndarray:
    """Turn Gaussians by a quarter where the second axis is longer, so that equal shapes have equal parameters.

    Returns where it turned them, bool (num,).
    """
    at = columns(degree)
    first, second = at["log_scale"].start, at["log_scale"].start + 1
    turned = state.rows[:, first] < state.rows[:, second]
    for array in (state.rows, state.first, state.second):
        array[turned, first], array[turned, second] = array[turned, second], array[turned, first]
    turn = 1 / (1 + np.exp(-state.rows[turned, at["angle_logit"].start].astype(float)))
    turn += np.where(turn < 0.5, 0.25, -0.25)
    state.rows[turned, at["angle_logit"].start] = np.log(turn / (1 - turn))
    return turned
