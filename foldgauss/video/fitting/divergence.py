"""Divergence: detected while a fit runs, named in a warning, and undone by a return to the last finite state.

The signs are parameters that are not finite, and errors that become much larger than they were. Either comes of
learning rates too high for the clip, or of a state that was broken before.
"""

import math
import warnings

import numpy as np

from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.schedule import BACKOFF_FACTOR
from foldgauss.video.fitting.state import FitState, StepResult
from foldgauss.video.models.row_layout import columns

#: Steps between the states that are kept to return to, at least.
KEEP_EVERY = 50
#: One more step between them for so many Gaussians: copies then take a hundredth of the time.
COPIED_PER_STEP = 8000
#: Steps between tests of all parameters; those of the Gaussians alive are tested after every step.
TEST_EVERY = 10
#: A mean squared error of so many times the lowest one known is no chance: 6 dB.
MUCH_WORSE = 4.0
#: Above 35 dB a fit has not diverged.
GOOD_ERROR = 3e-4
#: A fit that is worse than its start by this factor, 1 dB,
NOT_BETTER = 1.25
#: after so many passes does not converge.
START_PASSES = 6
#: How often a fit backs off, each time by `BACKOFF_FACTOR`: down to 1/4096 of its rates.
MAX_BACKOFFS = 6
#: How far a frame time's logit may move from that of the state kept, some `KEEP_EVERY` steps ago: its interval is then
#: e^15 times as long or short compared with the others, and float32 can no longer tell neighbors apart.
MAX_TIME_MOVE = 15.0
#: The least scale that a leaf's moves are measured in: where all start alike, as opacities do, their own spread is 0.
MIN_SCALE = {"loc": 0.3}  # of the frame; 1 for logits, logarithms, colors and folds
#: Errors of frames are compared after so many passes: all must have been seen.
PASSES = 2
#: Errors of frames are compared after so many steps.
MIN_STEPS = 20


class DivergenceWarning(RuntimeWarning):
    """A fit diverged; it continues from the last finite state with lower learning rates."""


class FitDiverged(ArithmeticError):
    """A fit diverged and stopped; `state` is the last finite one, None if there was none."""

    def __init__(self, message: str, state: FitState | None):
        super().__init__(message)
        self.state = state


class Guard:
    """Watches the steps of a fit. All that it decides by is in the state, so that resuming changes nothing.

    Errors are those of the same frames, each as it was last seen. A single frame raises no alarm,
    neither by being much harder than the others nor by being worse for a few steps: the worst one is left out. Where
    errors may rise for other reasons, only finiteness is tested: where Gaussians are added and pruned, and over the
    random backgrounds of frames with alpha.
    """

    def __init__(self, state: FitState, config: FitConfig, steps_per_pass: int, *, alpha: bool):
        self.config, self.steps_per_pass = config, steps_per_pass
        self.comparable = config.strategy.growth is None and not alpha
        fault = _find_nonfinite(state, config)
        if fault:
            cure = "Start a new fit instead of resuming this state."
            raise FitDiverged(f"state: expected finite parameters, got {fault} at step {state.step}. {cure}", None)
        if state.last_finite is None:
            self.restart(state)
            state.last_finite = state.copy()

    def restart(self, state: FitState) -> None:
        """From this step on, errors are not comparable with those before."""
        state.best_error = 0.0
        state.compare_from = state.step + max(PASSES * self.steps_per_pass, MIN_STEPS)
        state.improve_by = state.step + START_PASSES * self.steps_per_pass

    def find_fault(self, state: FitState, result: StepResult) -> str:
        """A description of what is wrong after a step; empty if nothing is."""
        finite = math.isfinite(result.loss) and result.finite and state.is_finite("time_logits")
        if not finite or (state.step % TEST_EVERY == 0 and not (state.is_finite("rows") and _has_valid_maps(state))):
            return _find_nonfinite(state, self.config) or f"a loss of {result.loss}"
        if state.backoffs >= MAX_BACKOFFS:
            return ""  # no back-off is left, and a bad fit is better than none
        if _time_move(state) > MAX_TIME_MOVE:
            return f"frame times moved by e^{_time_move(state):.0f} since step {state.last_finite.step}"
        if not self.comparable or state.step < state.compare_from:
            return ""
        worse = self._error_ratio(state)
        if worse > MUCH_WORSE:
            decibels, moved = 10 * math.log10(worse), self._most_moved(state)
            return f"frames are {decibels:.0f} dB worse than they were; {moved} moved most"
        if state.step >= state.improve_by and self._start_ratio(state) > NOT_BETTER:
            moved = self._most_moved(state)
            return f"frames are worse than at the start after {START_PASSES} passes; {moved} moved most"
        error = _mean_without_worst(state.frame_errors)
        state.best_error = min(error, state.best_error or error)
        return ""

    def replace_good(self, state: FitState) -> None:
        """Keep a copy of a state whose Gaussians are not comparable with those before, nor its errors."""
        self.restart(state)
        state.last_finite = state.copy()

    def keep_good(self, state: FitState) -> None:
        """Keep a copy of the state, every `KEEP_EVERY` steps or more, unless moments overflow or frames look bad."""
        due = state.step - state.last_finite.step >= max(KEEP_EVERY, state.num_gaussians // COPIED_PER_STEP)
        if state.backoffs and state.step < state.compare_from:
            return  # not all frames have been seen since the back-off
        most = 1 if state.backoffs else NOT_BETTER  # after a back-off, keep only states better than the start
        bad = self.comparable and (self._error_ratio(state) > MUCH_WORSE or self._start_ratio(state) > most)
        if due and not bad and state.is_finite("rows") and state.is_finite("second") and _has_valid_maps(state):
            state.last_finite = state.copy()

    def finish(self, state: FitState) -> None:
        """At the end of a fit that has backed off: if frames are worse than they were, restore the last state kept."""
        if not self.comparable or not state.backoffs:
            return
        worse, kept = self._error_ratio(state), state.last_finite
        if worse > MUCH_WORSE or self._start_ratio(state) > max(self._start_ratio(kept), 1):
            moved = self._most_moved(state)
            state.restore()
            warnings.warn(
                f"the fit ended at step {state.step} with frames {10 * math.log10(worse):.0f} dB worse than they were; "
                f"{moved} moved most. The result is that of step {kept.step}: lower these learning rates.",
                DivergenceWarning,
                stacklevel=3,
            )

    def back_off(self, state: FitState, fault: str) -> None:
        """Restore the arrays of the last finite state and lower the learning rates. The count of steps goes on.

        Raises FitDiverged if the fit has backed off `MAX_BACKOFFS` times. Its state is then that before the step, but
        for the arrays.
        """
        step, kept = state.step, state.last_finite
        state.restore()
        message = f"the fit diverged at step {step}: {fault}."
        if state.backoffs >= MAX_BACKOFFS:
            state.step = step - 1
            lowest = f"{BACKOFF_FACTOR**-MAX_BACKOFFS:.1g} of those given"
            cure = f"It did so even with learning rates {lowest}: lower these, or check the frames."
            raise FitDiverged(f"{message} The state is that of step {kept.step}. {cure}", state)
        state.backoffs += 1
        self.restart(state)
        rates = f"1/{BACKOFF_FACTOR**state.backoffs:.0f} of those given"
        warnings.warn(
            f"{message} It continues from step {kept.step} with learning rates {rates}.",
            DivergenceWarning,
            stacklevel=3,
        )

    def _error_ratio(self, state: FitState) -> float:
        """The error divided by the lowest one known."""
        error = _mean_without_worst(state.frame_errors)
        of_all = error / state.best_error if state.best_error > 0 and error > GOOD_ERROR else 0.0
        return max(of_all, self._start_ratio(state))

    def _start_ratio(self, state: FitState) -> float:
        """The error divided by that at the start, both over the frames for which that is known."""
        if not state.start_errors:
            return 0.0
        frames, errors = zip(*state.start_errors, strict=True)
        before, now = float(np.mean(errors)), float(np.mean(state.frame_errors[list(frames)]))
        return now / before if before > 0 and now > GOOD_ERROR else 0.0

    def _most_moved(self, state: FitState) -> str:
        """The leaf that moved farthest from the last finite state, in units of its spread there."""
        state.fetch_all()
        before, rows = state.last_finite.rows, state.rows
        if before.shape != rows.shape:
            return "some leaves"
        with np.errstate(over="ignore", invalid="ignore"):
            moved = {
                name: float(np.median(np.abs(rows[:, at] - before[:, at])))
                / max(float(before[:, at].std()), MIN_SCALE.get(name, 1.0))
                for name, at in columns(self.config.fold_degree).items()
                if at.stop > at.start
            }
        moved["frame times"] = _time_move(state)
        maps = state.path_maps
        if maps.size:
            moved["paths"] = float(np.median(np.abs(maps - state.last_finite.path_maps))) / MIN_SCALE["loc"]
        return max(moved, key=moved.get)


def _has_valid_maps(state: FitState) -> bool:
    """Whether the maps of shared paths are finite and none mirrors or flattens the image."""
    maps = state.path_maps
    with np.errstate(invalid="ignore", over="ignore"):
        return bool((np.isfinite(maps).all((-2, -1)) & (np.linalg.det(maps[..., :2]) > 0)).all())


def _mean_without_worst(errors: np.ndarray) -> float:
    """The mean error of all frames but the worst one; of a single frame, its error."""
    return float(np.sort(errors)[: max(len(errors) - 1, 1)].mean())


def _time_move(state: FitState) -> float:
    """The largest distance of a frame time's logit from the last finite state."""
    return float(np.abs(np.asarray(state.time_logits) - state.last_finite.time_logits).max(initial=0.0))


def _find_nonfinite(state: FitState, config: FitConfig) -> str:
    """The leaves with NaN or infinities, and how many Gaussians have them; empty if there are none."""
    state.fetch_all()
    found, rows = [], state.rows
    for name, at in columns(config.fold_degree).items():
        bad = np.flatnonzero(~np.isfinite(rows[:, at]).all(1))
        if len(bad):
            found.append(f"no finite {name} in {len(bad):,} Gaussians, the first of them {bad[0]}")
    if not _has_valid_maps(state):
        found.append("no maps of shared paths that can be inverted")
    if not np.isfinite(state.time_logits).all():
        found.append("no finite frame times")
    return "; ".join(found)
