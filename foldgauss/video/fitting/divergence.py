"""A fit that comes apart is seen, named and taken back to where it was still sound.

Two signs: numbers that are none, and pictures that become much worse than they have been. Either comes of rates that
are too high for the clip, or of a state that was broken before.
"""

import copy
import dataclasses
import math
import warnings

import jax
import numpy as np

from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import ARRAYS, FitState
from foldgauss.video.models.row_layout import columns

#: Steps from one sound state that is remembered to the next. (A copy of 40,000 Gaussians takes 4 ms.)
REMEMBERED = 50
#: A mean squared error of so many times the best one known is no chance: 6 dB.
MUCH_WORSE = 4.0
#: Above 35 dB nothing has come apart.
FINE = 3e-4
#: A fit that after so many passes is worse than its start by this, 1 dB, gets nowhere.
NO_BETTER, LOST_PASSES = 1.25, 6
#: Each time a fit is taken back its rates are divided by this, as often as `MOST_BACKOFFS`: down to 1/4096.
LOWERED, MOST_BACKOFFS = 4.0, 6
#: How far a frame time's logit may come from its last sound value, one of some `REMEMBERED` steps ago: by then its
#: interval is e^15 times as long or short by the others, and float32 tells neighbours no longer apart.
FARTHEST_TIME = 15.0
#: The least unit that a leaf's moves are judged in: where all start alike, as opacities do, their own spread is none.
LEAST_UNIT = {"loc": 0.3}  # of the frame; 1 for logits, logarithms, colours and folds
#: All frames must have been seen at a size before their errors are compared.
PASSES, LEAST_STEPS = 2, 20


class DivergenceWarning(RuntimeWarning):
    """A fit came apart and goes on from a sound state, at lower rates."""


class FitDiverged(ArithmeticError):
    """A fit came apart and stopped; `state` is the last sound one, None if there was none."""

    def __init__(self, message: str, state: FitState | None):
        super().__init__(message)
        self.state = state


def _copied(state: FitState) -> FitState:
    """As it is now, arrays and all, but for the sound state before; on the device that holds it."""
    if state.held is None:
        return jax.tree.map(np.array, dataclasses.replace(state, sound=None))
    other = copy.copy(state)
    other.sound, other.held = None, state.held.copied()
    return other


def _put_back(state: FitState) -> None:
    """The arrays of its last sound state are handed over as copies: a state owns what it updates in place."""
    state.held = None
    for name in ARRAYS:
        setattr(state, name, jax.tree.map(np.array, getattr(state.sound, name)))


class Guard:
    """Watches the steps of a fit. What it goes by is kept in the state, so that it knows as much after a stop.

    Errors are those of the same frames at the same size, each as it was last seen: a frame alone that is much harder
    than the others raises no alarm. Where they may rise for other reasons, only numbers are looked at: where Gaussians
    are born and dropped, and over the random backgrounds of frames with alpha.
    """

    def __init__(self, state: FitState, config: FitConfig, steps_per_pass: int, *, alpha: bool):
        self.config, self.steps_per_pass = config, steps_per_pass
        self.comparable = config.growth is None and config.economy is None and not alpha
        fault = _broken(state, config)
        if fault:
            cure = "Start anew, without the kept state."
            raise FitDiverged(f"state: expected finite numbers, got {fault} at step {state.step}. {cure}", None)
        if state.sound is None:
            self.restart(state)
            state.sound = _copied(state)

    def restart(self, state: FitState) -> None:
        """From this step on errors are those of other pictures."""
        state.settled = state.step + max(PASSES * self.steps_per_pass, LEAST_STEPS)
        state.should_be_better = state.step + LOST_PASSES * self.steps_per_pass

    def fault(self, state: FitState, loss: float) -> str:
        """What is wrong after a step, in words; empty if nothing is."""
        if not (math.isfinite(loss) and state.finite("rows") and state.finite("time_logits")):
            return _broken(state, self.config) or f"a loss of {loss}"
        if state.backoffs >= MOST_BACKOFFS:
            return ""  # where no tries are left, bad pictures are better than none
        if self._times_moved(state) > FARTHEST_TIME:
            return f"frame times moved by e^{self._times_moved(state):.0f} since step {state.sound.step}"
        if not self.comparable or state.step < state.settled:
            return ""
        worse = self._times_worse(state)
        if worse > MUCH_WORSE:
            decibels, moved = 10 * math.log10(worse), self._most_moved(state)
            return f"pictures {decibels:.0f} dB worse than they were, {moved} having moved most"
        if state.step >= state.should_be_better and self._times_start(state) > NO_BETTER:
            moved = self._most_moved(state)
            return f"pictures are worse than at the start after {LOST_PASSES} passes, {moved} having moved most"
        error = float(state.frame_errors.mean())
        state.best_error = min(error, state.best_error or error)
        return ""

    def _times_worse(self, state: FitState) -> float:
        """The error by the best one known."""
        error = float(state.frame_errors.mean())
        of_all = error / state.best_error if state.best_error > 0 and error > FINE else 0.0
        return max(of_all, self._times_start(state))

    def _times_start(self, state: FitState) -> float:
        """The error by that of the start, both of the frames of which that is known."""
        if not state.start_errors:
            return 0.0
        frames, errors = zip(*state.start_errors, strict=True)
        before, now = float(np.mean(errors)), float(np.mean(state.frame_errors[list(frames)]))
        return now / before if before > 0 and now > FINE else 0.0

    def remember(self, state: FitState) -> None:
        """Now and then, of a state in which nothing is wrong. One whose moments overflow is not sound, nor one whose
        pictures look bad, be it by too few of them to say so."""
        due = state.step - state.sound.step >= REMEMBERED
        if state.backoffs and state.step < state.settled:
            return  # what the errors were, and are now, is not known of all frames
        bad = self.comparable and (self._times_worse(state) > MUCH_WORSE or self._times_start(state) > NO_BETTER)
        if due and not bad and state.finite("second"):
            state.sound = _copied(state)

    def finish(self, state: FitState) -> None:
        """At the end: where no tries were left and pictures came out worse than they were, they are those of before."""
        if not self.comparable or state.backoffs < MOST_BACKOFFS:
            return
        worse = max(self._times_worse(state), self._times_start(state))
        if worse > MUCH_WORSE or self._times_start(state) > NO_BETTER:
            decibels = 10 * math.log10(worse)
            told = f"the fit ended at step {state.step} with pictures {decibels:.0f} dB worse than they were"
            moved, start = self._most_moved(state), state.sound.step
            _put_back(state)
            state.error = state.sound.error or float(np.mean([error for _, error in state.start_errors] or [0.0]))
            cure = f"What is kept is of step {start}: lower these rates."
            warnings.warn(f"{told}, {moved} having moved most. {cure}", DivergenceWarning, stacklevel=3)

    def back_off(self, state: FitState, fault: str, error_before: float) -> None:
        """Take the arrays of `state` back, and lower its rates. Steps go on counting: so a fit ends when it should.

        Raises FitDiverged if the fit is to stop, or has been taken back `MOST_BACKOFFS` times. Its state is then that
        before the step, whose running error was `error_before`, but for the arrays.
        """
        step, start = state.step, state.sound.step
        _put_back(state)
        told = f"the fit came apart at step {step}: {fault}."
        lowest = state.backoffs >= MOST_BACKOFFS
        if self.config.on_divergence == "stop" or lowest:
            state.step, state.error = step - 1, error_before
            cure = "Give lower rates, or 'back-off', which finds them."
            if lowest:
                lowest_rates = f"{LOWERED**-MOST_BACKOFFS:.1g} of those asked for"
                cure = f"So it did with rates {lowest_rates}: lower these, or look at the frames."
            raise FitDiverged(f"{told} What is kept is of step {start}. {cure}", state)
        state.backoffs += 1
        state.error = state.sound.error
        self.restart(state)
        rates = f"{LOWERED**state.backoffs:.0f}th"
        warnings.warn(f"{told} It goes on from step {start}, with rates a {rates}.", DivergenceWarning, stacklevel=3)

    def _most_moved(self, state: FitState) -> str:
        """The leaf that is farthest from where it was when all was sound, by its own spread then."""
        before, rows = state.sound.rows, state.rows
        if before.shape != rows.shape:
            return "some leaves"
        with np.errstate(over="ignore", invalid="ignore"):
            moved = {
                name: float(np.median(np.abs(rows[:, at] - before[:, at])))
                / max(float(before[:, at].std()), LEAST_UNIT.get(name, 1.0))
                for name, at in columns(self.config.degree).items()
                if at.stop > at.start
            }
        moved["frame times"] = self._times_moved(state)
        return max(moved, key=moved.get)

    def _times_moved(self, state: FitState) -> float:
        """The farthest that a frame time's logit is from where it was when all was sound."""
        return float(np.abs(np.asarray(state.time_logits) - state.sound.time_logits).max(initial=0.0))


def _broken(state: FitState, config: FitConfig) -> str:
    """The leaves with numbers that are none, and how many Gaussians have them; empty if there are none."""
    found = []
    rows = state.rows
    for name, at in columns(config.degree).items():
        bad = np.flatnonzero(~np.isfinite(rows[:, at]).all(1))
        if len(bad):
            found.append(f"no finite {name} in {len(bad):,} Gaussians, the first of them {bad[0]}")
    if not np.isfinite(state.time_logits).all():
        found.append("no finite frame times")
    return "; ".join(found)
