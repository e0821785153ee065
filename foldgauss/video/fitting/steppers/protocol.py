"""`Stepper`: what computes the steps of a fit, as the loop calls it."""

from typing import NamedTuple, Protocol

from foldgauss.video.fitting.state import FitState


class StepResult(NamedTuple):
    """What one step reports."""

    loss: float  #: mean over the batch
    num_alive: int  #: Gaussians that took part
    finite: bool = True  #: whether the parameters of these are finite after the step


class Stepper(Protocol):
    """Computes the steps of a fit. Methods change the state in place."""

    steps_per_pass: int

    def step(self, state: FitState, progress: float) -> StepResult:
        """One step at a fraction of the plan. The step counter is the caller's."""

    def adopt(self, state: FitState) -> None:
        """Prepare for a state whose arrays were replaced."""

    def measure_start(self, state: FitState) -> dict[int, float]:
        """Mean squared errors of some frames, by frame."""
