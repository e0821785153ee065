"""`DensityControl`: what adds, removes, moves or changes Gaussians between the steps of a fit."""

import abc

from foldgauss.video.fitting.state import FitState


class DensityControl(abc.ABC):
    """A base class: `fit` asks `is_due` after each step, and calls `apply` where it is.

    `apply` changes the state in place, by `FitState.keep` and `extend`, or by new arrays; all arrays are then on the
    host, whatever the engine. What it needs to know must be in the state or follow from the settings, so that a resumed
    fit continues as if uninterrupted; its random numbers should depend on a seed and `state.step`.

    Source: the adaptive density control of Kerbl et al. 2023, section 5.
    """

    plans_time: bool = False  #: whether `apply` takes long enough to be planned apart from the steps, by `reserve`
    seconds: float = 0.0  #: that the longest call of `apply` took, set by the fit if it `plans_time`

    @abc.abstractmethod
    def is_due(self, state: FitState) -> bool:
        """Whether to call `apply` now: `state.step` steps are done. Called after every step, so it should be cheap.

        Of the arrays, those that every step fetches are on the host (`FitState`) with all engines.
        """

    @abc.abstractmethod
    def apply(self, state: FitState) -> None:
        """Change the Gaussians of the state."""

    def reserve(self, state: FitState) -> float:
        """Seconds that the calls to come will take, for which a fit with a limited time keeps them.

        Arrays are where they are for `is_due`.
        """
        return 0.0
