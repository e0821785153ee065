"""The budget of a fit: its number of steps, planned from minutes; when it stops; how much time is left."""

import math

from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState

#: The speed is measured after so many steps, in which kernels are compiled or loaded.
WARM_UP = 5
#: The speed is measured over at least so many steps.
MIN_STEPS = 10
#: The fractions of the time or of the plan, whichever is first, at which the number of steps is planned, by the speed
#: since the one before.
PLANNED_AT = (0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.97)
#: Steps of the whole fit are slower than the first ones by this: Gaussians grow longer in time.
SLOWDOWN = 1.05


class StepPlanner:
    """Turns minutes into a number of steps, by the measured speed, and corrects it at stated times (`PLANNED_AT`).

    The plan is a part of the state: everything else in a fit is a function of steps and of the plan, so that a resumed
    fit continues as if it had not been interrupted. Densification follows a schedule of the whole plan: with it the
    plan is made once.
    """

    def __init__(self, config: FitConfig):
        self.config, self.count, self.seconds = config, -WARM_UP, 0.0  # steps since the last plan, and their time
        self.before = 0.0  # the state's seconds after the step before
        self.reserved = 0.0  # seconds that actions between steps will take

    def skip(self, seconds: float, reserved: float) -> None:
        """An action between two steps took `seconds`, which are none of a step; later ones will take `reserved`."""
        self.before += seconds
        self.reserved = reserved

    def update(self, state: FitState) -> None:
        """Plan the steps of the whole fit, if it is time, after a step."""
        config, passed = self.config, state.seconds - self.before
        self.before = state.seconds
        if config.minutes is None or (state.plan and (config.strategy.growth is not None or state.step >= state.plan)):
            return
        budget = 60 * config.minutes
        if not state.plan and (state.step == config.steps or state.seconds >= budget):
            state.plan = state.step
            return
        self.count += 1
        if self.count > 0:
            self.seconds += passed
        if not self._is_due(state, budget):
            return
        seconds = max(budget - state.seconds - self.reserved, (budget - state.seconds) / 2)
        left = seconds * self.count / self.seconds / SLOWDOWN
        if state.plan:
            state.planned_step, state.planned_progress = state.step, measure_progress(state, config)
        state.plan = min(state.step + max(int(left), 0), config.steps or math.inf)
        self.count, self.seconds = 0, 0.0

    def _is_due(self, state: FitState, budget: float) -> bool:
        if self.count < MIN_STEPS:
            return False
        if not state.plan:
            enough = self.seconds >= PLANNED_AT[0] * budget
            return enough or (self.config.steps is not None and state.step >= self.config.steps * PLANNED_AT[0])
        # Also by the steps of the plan: where steps have become faster, the fit would otherwise end early.
        before = max((state.seconds - self.seconds) / budget, state.planned_progress)
        now = max(state.seconds / budget, measure_progress(state, self.config))
        return any(before < part <= now for part in PLANNED_AT)


class TimeLeft:
    """Estimates how long a fit will still take, by the speed since it began or was resumed, without the first steps."""

    def __init__(self, state: FitState, config: FitConfig):
        self.config, self.first = config, state.step + WARM_UP
        self.seconds, self.progress = math.nan, math.inf

    def estimate(self, state: FitState, progress: float) -> float:
        """Seconds; at most what is left of the minutes, where they are limited."""
        most = math.inf if self.config.minutes is None else max(60 * self.config.minutes - state.seconds, 0.0)
        if state.step <= self.first or not state.plan:
            self.seconds, self.progress = state.seconds, progress
        if progress <= self.progress:
            return most
        return min((state.seconds - self.seconds) * (1 - progress) / (progress - self.progress), most)


def measure_progress(state: FitState, config: FitConfig, step: int | None = None) -> float:
    """The fraction of the plan that is done; without a plan, of the steps asked for, or 0.

    `step`: after so many steps instead of those taken, by the present plan.
    """
    step = state.step if step is None else step
    plan, start, done = state.plan or config.steps, state.planned_step, state.planned_progress
    if not plan:
        return 0.0
    return done + (1 - done) * (step - start) / max(plan - start, 1)


def find_limit(state: FitState, config: FitConfig) -> str | None:
    """The budget that ends the fit now: "steps" or "minutes"."""
    # Minutes are planned by the speed with the Gaussians at the start: where Gaussians are added, the clock decides.
    if config.strategy.growth is not None and config.minutes is not None and state.seconds >= 60 * config.minutes:
        return "minutes"
    if not state.plan or state.step < state.plan:
        return None
    return "minutes" if config.minutes is not None and state.plan != config.steps else "steps"
