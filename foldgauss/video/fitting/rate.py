r"""Rate: a fit whose result is a compact model, the least of squared error plus a price times bits.

The objective is $D + \lambda R$: D the squared error in levels of 8 bits, summed over the clip, R the bits of the
compact file. Two actions reduce it while the others adapt, at stated fractions of the plan (`ACTIONS`):

* In the first half Gaussians are dropped whose removal adds less squared error than $\lambda$ times their bits, and the
  others are sorted by cells of space and time, which saves bits.
* From then on the parameters of ever more Gaussians are rounded and no longer trained: shapes first, then trajectories,
  then colors. A step of rounding is as coarse as $\lambda$ makes it worth, see `compression.quantizer`.

`FitConfig.quality` states $\lambda$. A largest file and a least PSNR determine it during the fit, by the sizes that the
coder finds for the Gaussians at hand, and by the images that they give. Source for the steps: the theory of
rate and distortion at high resolution (Gish and Pierce 1968); for the order: `docs/compress.md`.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import invalid
from foldgauss.video.compression.quantize import (
    Quantized,
    Rule,
    column_names,
    compute_columns,
    dequantize,
    is_integral,
    quantize,
)
from foldgauss.video.compression.quantizer import Quantizer, find_order, round_groups, select_rows
from foldgauss.video.compression.streams import encode_streams
from foldgauss.video.fitting.config import FitConfig
from foldgauss.video.fitting.state import FitState, to_model
from foldgauss.video.models.background import BLACK, composite
from foldgauss.video.models.metrics import psnr as psnr_of
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import COLOR, GROUPS, SHAPE, TRAJECTORY, columns, pack
from foldgauss.video.models.video_model import VideoModel

#: Coarseness, the binary logarithm of the factor of all steps, at quality 0 and 100; between them it is linear.
COARSEST, FINEST = 11.0, 1.0
#: Bytes of a file beside its streams: its header, and what is known of the clip.
HEADER_BYTES = 4096
#: Fraction of the largest file that the fit aims at; the Gaussians that are worth least are dropped in the end if the
#: file is larger nevertheless.
_AIM = 0.98
#: Frames that a PSNR is estimated from, and by how much it may be missed when the coarseness is chosen, dB.
_TRIED_FRAMES, _TOLERANCE_DB = 12, 0.03
#: Tries of the coarseness, at most, its first change, and the binary logarithm by which a size may be missed.
_TRIES, _FIRST_CHANGE, _TOLERANCE_LOG2 = 6, 0.5, 0.015
#: Squared error that sorting may add, as a fraction of the model's own, with so many passes over the frames to come.
#: Fewer compensate for less of it.
_ORDERING, _PASSES = 1.0, 40.0
#: The same without any, as a fraction of the variance of the images.
_ORDERING_UNTRAINED = 1e-5


class Action(NamedTuple):
    """What is done once a fraction of the plan is over: "drop", "sort", or the group of leaves to round.

    `extent`: the fraction of the price of a bit at which Gaussians are dropped, or of the Gaussians that are rounded.
    `gain`: by how many dB the PSNR rises from then to the end, about, compared with that of everything rounded.
    """

    progress: float
    what: str | tuple[str, ...]
    extent: float = 1.0
    gain: float = 0.0


ACTIONS = (
    Action(0.1, "drop", 0.04, 5.0),
    Action(0.2, "drop", 0.16, 3.8),
    Action(0.3, "drop", 0.36, 3.1),
    Action(0.4, "drop", 0.64, 2.6),
    Action(0.5, "drop", 1.0, 2.2),
    Action(0.5, "sort"),
    Action(0.6, SHAPE, 0.4, 1.6),
    Action(0.71, SHAPE, 0.75),
    Action(0.82, SHAPE, 1.0),
    Action(0.89, TRAJECTORY, 0.5),
    Action(0.95, TRAJECTORY, 1.0),
    Action(0.98, COLOR, 0.5),
)
#: The fraction of a plan from which a model that is already fitted becomes compact.
COMPRESSION_START = 0.35


class RateControl:
    """Makes the Gaussians of a running fit worth their bits."""

    def __init__(self, frames: np.ndarray, config: FitConfig):
        self.frames, self.config = frames, config
        self.sampled = np.unique(np.linspace(0, len(frames) - 1, _TRIED_FRAMES).round().astype(int))

    def check_size(self, state: FitState) -> None:
        """Raise ValueError if a file of a single Gaussian is larger than the settings allow."""
        if self.config.size_mb is None:
            return
        exact, one = compute_columns(self._model(state)), np.arange(state.num_gaussians) == 0
        rules = {name: Rule(0.0, COARSEST) for name in column_names(self.config.degree) if not is_integral(name)}
        least = count_bytes(quantize(select_rows(exact, one), np.zeros(1, np.int32), rules)) / 1e6
        if least > self.config.size_mb:
            raise invalid("size_mb", expected=f"at least {least:.4f} for this clip", got=self.config.size_mb)

    def act(self, state: FitState, progress: float) -> bool:
        """Take the actions that are due; whether arrays of the state were replaced."""
        before = state.rate_actions
        if before < len(ACTIONS) and progress >= ACTIONS[before].progress:
            state.fetch_all()
        while state.rate_actions < len(ACTIONS) and progress >= ACTIONS[state.rate_actions].progress:
            action = ACTIONS[state.rate_actions]
            if action.what == "drop":
                self._drop(state, action)
            elif action.what == "sort":
                passes = (state.plan - state.step) * self.config.batch_size / len(self.frames)
                error = float(state.frame_errors.mean()) * self.frames[..., :3].size
                state.keep(find_order(self._model(state), _ORDERING * min(passes / _PASSES, 1.0) * error))
            else:
                self._round(state, action)
            state.rate_actions += 1
        return state.rate_actions > before

    def round_only(self, state: FitState) -> None:
        """Drop what is not worth its bits, and sort where that hardly changes the images, without any training."""
        self._drop(state, Action(0.0, "drop"))
        model = self._model(state)
        levels = sum(float(frame.astype(np.float64).var()) for frame in self.frames) * self.frames[0].size
        state.keep(find_order(model, _ORDERING_UNTRAINED * levels / 255**2))
        self._choose_rules(state, gain=0.0)

    def finish(self, state: FitState, fps: float = 25.0) -> Quantized:
        """The compact model of a fit at its end."""
        if not state.rules:
            self._choose_rules(state, gain=0.0)
        exact = compute_columns(self._model(state, fps))
        classes, rules = state.classes.astype(np.int32), _decode_rules(state)
        whole = quantize(exact, classes, rules)
        if self.config.size_mb is None and self.config.psnr is None:
            return whole
        worst_first = np.argsort(Quantizer(dequantize(whole)).removal, kind="stable")

        def without(num: int) -> Quantized:
            kept = np.ones(len(worst_first), bool)
            kept[worst_first[:num]] = False
            return quantize(select_rows(exact, kept), classes[kept], rules)

        most, dropped = len(worst_first) - 1, 0
        if self.config.psnr is not None and self._psnr(whole, all_frames=True) > self.config.psnr:
            dropped = _last(lambda num: self._psnr(without(num), all_frames=True) >= self.config.psnr, most)[0]
        if self.config.size_mb is not None and count_bytes(without(dropped)) > 1e6 * self.config.size_mb:
            dropped = min(_last(lambda num: count_bytes(without(num)) > 1e6 * self.config.size_mb, most)[1], most)
        return without(dropped) if dropped else whole

    def _model(self, state: FitState, fps: float = 25.0) -> VideoModel:
        return to_model(state, self.config, self.frames.shape[1:3], fps)

    def _drop(self, state: FitState, action: Action) -> None:
        quantizer = Quantizer(self._model(state))
        coarseness = self._choose_coarseness(quantizer, action.gain, drops=True)
        state.keep(np.flatnonzero(quantizer.are_worth(coarseness, action.extent)))

    def _round(self, state: FitState, action: Action) -> None:
        """Round a fraction of the Gaussians; those that are rounded already are among them."""
        if not state.rules:
            self._choose_rules(state, action.gain)
        num, bit = state.num_gaussians, GROUPS[action.what]
        rank = make_generator(Stream.ROUNDING_ORDER, seed=self.config.seed).permutation(num) / num
        rounded = state.rounded | np.where(rank < action.extent, np.uint8(bit), np.uint8(0))
        splats = round_groups(self._model(state), state.classes.astype(np.int32), _decode_rules(state), rounded)
        rows, first, second = pack(splats), state.first.copy(), state.second.copy()
        newly = (rounded != state.rounded)[:, None]
        for name in action.what:  # Adam does not move what has neither a gradient nor moments
            at = columns(self.config.degree)[name]
            for moments in (first, second):
                moments[:, at] = np.where(newly, np.float32(0), moments[:, at])
        state.rows, state.first, state.second, state.rounded = rows, first, second, rounded

    def _choose_rules(self, state: FitState, gain: float) -> None:
        quantizer = Quantizer(self._model(state))
        rules = quantizer.make_rules(self._choose_coarseness(quantizer, gain, drops=False))
        state.rules = tuple((name, rule.origin, rule.exponent, rule.slopes) for name, rule in rules.items())
        state.classes = quantizer.classes.astype(np.int8)

    def _choose_coarseness(self, quantizer: Quantizer, gain: float, *, drops: bool) -> float:
        """The coarsest of what quality, size and PSNR ask for, where those not worth their bits are dropped or not."""
        config, wanted = self.config, []

        def quantized(coarseness: float) -> Quantized:
            return quantizer.quantize(coarseness, quantizer.are_worth(coarseness) if drops else None)

        if config.quality is not None:
            wanted.append(COARSEST + (FINEST - COARSEST) * config.quality / 100)
        guess = wanted[0] if wanted else (COARSEST + FINEST) / 2
        if config.size_mb is not None:
            target = math.log2(max(_AIM * 1e6 * config.size_mb - HEADER_BYTES, 64))
            excess = lambda c: math.log2(count_bytes(quantized(c)) - HEADER_BYTES) - target  # noqa: E731
            wanted.append(_solve(excess, guess, _TOLERANCE_LOG2))
        if config.psnr is not None:
            target = config.psnr - gain
            wanted.append(_solve(lambda c: self._psnr(quantized(c)) - target, guess, _TOLERANCE_DB))
        return max(wanted)

    def _psnr(self, quantized: Quantized, *, all_frames: bool = False) -> float:
        """Mean PSNR, dB, of sampled frames or of all."""
        model, which = dequantize(quantized), np.arange(len(self.frames)) if all_frames else self.sampled
        images = VideoRenderer(model).frames(np.asarray(model.frame_times.times())[which])
        return float(np.mean([psnr_of(self._target(k), image) for k, image in zip(which, images, strict=True)]))

    def _target(self, k: int) -> np.ndarray:
        frame = self.frames[k]
        return frame if frame.shape[-1] == 3 else composite(frame, np.float32(BLACK))


def count_bytes(quantized: Quantized) -> int:
    """The bytes of a file, with `HEADER_BYTES` for its header."""
    return HEADER_BYTES + sum(map(len, encode_streams(quantized).values()))


def count_past(progress: float) -> int:
    """The number of actions before a fraction of the plan."""
    return sum(action.progress < progress for action in ACTIONS)


def _decode_rules(state: FitState) -> dict[str, Rule]:
    return {name: Rule(*numbers) for name, *numbers in state.rules}


def _solve(excess: Callable[[float], float], guess: float, tolerance: float) -> float:
    """Where a decreasing function of the coarseness is 0, by secants within what is known; not below `FINEST`."""
    low, high = (FINEST, math.inf), (COARSEST, -math.inf)  # coarseness and excess
    at = guess
    for _ in range(_TRIES):
        now = excess(at)
        if abs(now) <= tolerance:
            return at
        low, high = ((at, now), high) if now > 0 else (low, (at, now))
        if math.isfinite(low[1]) and math.isfinite(high[1]):
            fraction = low[1] / (low[1] - high[1])
            at = low[0] + min(max(fraction, 0.1), 0.9) * (high[0] - low[0])
        else:
            slope = 1.0 if tolerance == _TOLERANCE_LOG2 else 2.5
            at = min(max(at + now / slope, FINEST), COARSEST)
    return low[0] if math.isfinite(low[1]) else at


def _last(holds: Callable[[int], bool], most: int) -> tuple[int, int]:
    """The last number up to `most` for which a condition holds that holds up to some number, and one after it.

    To half a percent: it holds for the first of both, unless that is 0, and not for the second, unless that is beyond
    `most`.
    """
    low, high = 0, most + 1
    while high - low > max(low // 200, 1):
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low, high
