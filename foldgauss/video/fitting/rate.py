r"""Rate: a fit whose result is a compact model, the least of squared error plus a price times bits.

The objective is $D + \lambda R$: D the squared error in levels of 8 bits, summed over the clip, R the bits of the
compact file. Two actions reduce it while the others adapt, at stated fractions of the plan (`ACTIONS`):

* Gaussians are dropped whose removal adds less squared error than $\lambda$ times their bits, and the others are sorted
  by cells of space and time, which saves bits. Where a PSNR is asked for that is out of reach, Gaussians are added.
* In the last part the parameters of ever more Gaussians are rounded and no longer trained: shapes first, then
  trajectories, then colors. A step of rounding is as coarse as $\lambda$ makes it worth, see `compression.quantizer`.

`FitConfig.quality` states $\lambda$. A largest file and a least PSNR determine it during the fit, by the number of
Gaussians that the file holds, the sizes that the coder finds, and the PSNR of some frames. Source for the steps: the
theory of rate and distortion at high resolution (Gish and Pierce 1968); for the order: `docs/compress.md`.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import brentq

from foldgauss._numerics.random_streams import Stream, make_generator
from foldgauss._runtime.checks import require
from foldgauss.video.compression.chunks import arrange, divide_anew
from foldgauss.video.compression.quantize import (
    Quantized,
    Rule,
    column_names,
    compute_columns,
    dequantize,
    is_integral,
    quantize,
    select_rows,
)
from foldgauss.video.compression.quantizer import (
    BEYOND_BLACK,
    BITS_PER_GAUSSIAN,
    Quantizer,
    Worth,
    bit_price,
    round_groups,
)
from foldgauss.video.compression.streams import encode_chunk, encode_motion
from foldgauss.video.fitting.budget import measure_progress
from foldgauss.video.fitting.config import START_PER_TIME, FitConfig, most_gaussians, time_per_pixel
from foldgauss.video.fitting.density_control import DensityControl
from foldgauss.video.fitting.relocation import add, errors_are_known
from foldgauss.video.fitting.schedule import count_passes
from foldgauss.video.fitting.state import FitState, running_psnr, to_model
from foldgauss.video.models.background import BLACK, WHITE, Background, composite
from foldgauss.video.models.metrics import psnr as psnr_of
from foldgauss.video.models.renderer import VideoRenderer
from foldgauss.video.models.row_layout import COLOR, GROUPS, SHAPE, TRAJECTORY, columns, pack
from foldgauss.video.models.video_model import VideoModel
from foldgauss.video.motion.optical_flow import Motion

#: Coarseness, the binary logarithm of the factor of all steps, at quality 0. Up to quality 100 it is linear.
COARSEST = 11.0
#: The same at quality 100.
FINEST = 1.0
#: Bytes of a file beside its streams: its header, and what is known of the clip.
HEADER_BYTES = 3000
#: Bytes of the header for each degree of the folds above 1.
BYTES_PER_DEGREE = 80
#: Bytes of the header for each chunk.
BYTES_PER_CHUNK = 110
#: Bytes of the header for the length of a stream.
BYTES_PER_STREAM = 8
#: Bytes of a learned frame time, at most in usual clips; evenly spaced ones take hardly any.
BYTES_PER_TIME = 1.6
#: How finely the coarseness is searched for a size, which changes by more until the end of the fit: 1% of the bytes.
_TOLERANCE_OF_SIZE = 0.02
#: By how many dB dropping has to worsen the images at once for what remains of it to be measured.
_LEAST_MEASURED_DB = 0.05
#: The coarseness of dropping where no PSNR can be spared.
_LEAST_DROPPED = -COARSEST
#: How finely the coarseness is searched for a PSNR.
_TOLERANCE = 0.1
#: Frames that a PSNR is estimated by.
_SAMPLED_FRAMES = 12
#: By how many dB the PSNR of a finished fit falls for each unit of coarseness: 1.3 to 2.5 in usual clips.
_DB_PER_UNIT = 2.0
#: How much finer the steps may become between two actions, as a binary logarithm.
_MOST_FINER = 0.5
#: How many dB rounding for a PSNR may cost at once.
_MOST_ROUNDED_DB = 1.0
#: How many dB dropping for a PSNR may cost at once where the fit has made up for all of the last dropping.
_MOST_DROPPED_DB = 4.5
#: The same where nothing was dropped before.
_FIRST_DROPPED_DB = 2.0
#: How many dB it may cost before `_TRUSTED_FROM`, whatever the PSNR is.
_RISKED_DB = 0.25
#: The fraction of the plan from which on the PSNR alone tells how much may be dropped.
_TRUSTED_FROM = 0.42
#: The fraction of the plan up to which Gaussians are added where a PSNR is out of reach of those that there are.
_ADDED_UNTIL = 0.55
#: Mean squared errors of a frame below this, in [0, 1], count as 0: its PSNR is at its maximum.
_PERFECT = 1e-10
#: The PSNR of a frame is clipped at the goal plus this, in dB. Nearly perfect frames, such as black ones, then do not
#: compensate for poor ones.
_MOST_OVER_DB = 6.0
#: The gain of a model that was finished already, at most.
_GAIN_OF_GIVEN = 0.2
#: The fraction of the gain of an action that is sure.
_SURE = 0.2
#: Lambda R / D in usual fits of a quality, where Gaussians are dropped at the full price. R counts those that are kept.
_USUAL_COST = 1.3
#: The power of the fraction of the price by which this ratio changes at earlier droppings.
_COST_POWER = -0.37
#: Fits of fewer passes over the frames aim at a ratio that is smaller in proportion.
_USUAL_PASSES = 60.0
#: By how much more passes are left in a fit by minutes than its speed so far suggests: steps of fewer Gaussians, of
#: which ever more are rounded, are faster.
_SPEEDUP = 2.0
#: By how many dB the fit aims at more than it was asked for: what is too much is given up in the end.
_MARGIN_DB = 0.3
#: Bits of a Gaussian in a file whose number of Gaussians suits its steps, as measured.
USUAL_BITS = 75.0
#: The least fraction of the Gaussians that remains: each is judged as if the others remained.
_LEAST_KEPT = 0.45
#: Squared error that sorting may add, as a fraction of the model's own, which many passes compensate for.
_ORDERING = 0.1
#: Passes over the frames to come that count as many; fewer compensate for less of what an action costs.
_PASSES = 40.0
#: The least fraction of the price of a bit at which Gaussians are dropped where nothing makes up for them.
_LEAST_FRACTION = 1e-4
#: Tries of the number of Gaussians that are dropped in the end.
_TRIALS = 10
#: Squared error that sorting may add without training, as a fraction of the variance of the images.
_ORDERING_UNTRAINED = 1e-5


class Action(NamedTuple):
    """What is done after a fraction of the plan: "drop", "sort", "divide" into chunks, or the group of leaves to round.

    `extent`: the fraction of the price of a bit at which Gaussians are dropped, or of the Gaussians that are rounded.
    `gain`: by how many dB at most the finished model is expected to exceed the mean PSNR before and after a dropping,
    or the PSNR before rounding. It is about half of the rise in fits of a quality.
    """

    progress: float
    what: str | tuple[str, ...]
    extent: float = 1.0
    gain: float = 0.0


ACTIONS = (
    Action(0.1, "drop", 0.04, 2.0),
    Action(0.2, "drop", 0.16, 1.7),
    Action(0.3, "drop", 0.36, 1.3),
    Action(0.42, "drop", 0.64, 1.2),
    Action(0.55, "drop", 1.0, 0.75),
    Action(0.55, "sort"),
    Action(0.7, SHAPE, 0.4, 0.3),
    Action(0.78, SHAPE, 0.75),
    Action(0.84, "drop", 1.0, 0.15),
    Action(0.86, SHAPE, 1.0),
    Action(0.86, "divide"),  # when Gaussians are visible does not change from now on
    Action(0.91, TRAJECTORY, 0.5),
    Action(0.96, TRAJECTORY, 1.0),
    Action(0.985, COLOR, 0.5),
)
#: The fraction of a plan from which a model that is already fitted becomes compact.
COMPRESSION_START = 0.35


class RateControl(DensityControl):
    """Makes the Gaussians of a running fit worth their bits."""

    plans_time = True

    def __init__(self, frames: np.ndarray, config: FitConfig, find_motion: Callable[[], Motion | None] = lambda: None):
        self.frames, self.config, self.find_motion = frames, config, find_motion
        self.trimming = {"psnr": 0.0, "size_mb": 0.0}  # seconds that the last dropping takes for each
        self.background = BEYOND_BLACK if frames.shape[-1] == 4 else np.float32(BLACK)
        self.sampled = np.unique(np.linspace(0, len(frames) - 1, _SAMPLED_FRAMES).round().astype(int))

    def check_size(self, state: FitState) -> None:
        """Raise ValueError if a file of a single Gaussian is larger than the settings allow."""
        size = self.config.size_mb
        if size is None:
            return
        exact, one = compute_columns(self._model(state)), np.arange(state.num_gaussians) == 0
        rules = {name: Rule(0.0, COARSEST) for name in column_names(self.config.fold_degree) if not is_integral(name)}
        least = count_bytes(quantize(select_rows(exact, one), np.zeros(1, np.int32), rules)) / 1e6
        if self.config.learns_frame_times:
            least += BYTES_PER_TIME * len(self.frames) / 1e6
        require(least <= size, "size_mb", expected=f"at least {least:.4f} for this clip", got=size)

    def is_due(self, state: FitState) -> bool:
        left = ACTIONS[state.rate_actions :]
        return bool(state.plan and left) and measure_progress(state, self.config) >= left[0].progress

    def apply(self, state: FitState) -> None:
        """Take the actions that are due."""
        while self.is_due(state):
            action = ACTIONS[state.rate_actions]
            if action.what == "drop":
                self._drop(state, action)
            elif action.what == "divide":
                self._keep_in_chunks(state, *divide_anew(self._model(state), state.chunks))
            elif action.what == "sort":
                error = float(state.frame_errors.mean()) * self.frames[..., :3].size
                budget = _ORDERING * self._adaptation(state, action) * error
                self._keep_in_chunks(state, *arrange(self._model(state), budget))
            else:
                self._round(state, action)
            state.rate_actions += 1
        state.start_errors = ()  # measured with more Gaussians

    def reserve(self, state: FitState) -> float:
        """Seconds of the remaining actions that measure Gaussians, and of the dropping at the end."""
        left = [action for action in ACTIONS[state.rate_actions :] if action.what == "drop"]
        return self.seconds * (len(left) + (not state.rules)) + sum(self.trimming.values())

    def round_only(self, state: FitState) -> None:
        """Drop what is not worth its bits, and sort where that hardly changes the images, without any training."""
        worth = Worth(self._model(state), self.background)
        coarseness = self._choose_coarseness(state, worth, Action(1.0, "drop"))
        model, fraction = self._model(state), 1.0
        # Each is judged as if the others stayed, and nothing makes up for what is missing: fewer, where it costs more.
        while True:
            kept = worth.are_worth(coarseness, fraction)
            fewer = dataclasses.replace(model, splats=model.splats.take(kept))
            added = _error_at(self._psnr(fewer, np.arange(len(self.frames)))) * 255**2 * self.frames[..., :3].size
            if (
                kept.all()
                or added <= (~kept).sum() * BITS_PER_GAUSSIAN * bit_price(coarseness)
                or fraction < _LEAST_FRACTION
            ):
                break
            fraction /= 2
        state.keep(np.flatnonzero(kept))
        levels = sum(float(frame.astype(np.float64).var()) for frame in self.frames) * self.frames[0].size
        budget = _ORDERING_UNTRAINED * levels / 255**2
        self._keep_in_chunks(state, *arrange(self._model(state), budget, layered=False))
        self._choose_rules(state, Action(1.0, COLOR))

    def finish(self, state: FitState, fps: float = 25.0) -> Quantized:
        """The compact model of a fit at its end."""
        if not state.rules:
            self._choose_rules(state, Action(1.0, COLOR))
        exact = compute_columns(self._model(state, fps))
        classes, rules = state.classes.astype(np.int32), _decode_rules(state)
        whole = quantize(exact, classes, rules, state.chunks)
        if self.config.size_mb is None and self.config.psnr is None:
            return whole
        worst_first = np.argsort(Worth(dequantize(whole), self.background).removal, kind="stable")

        def without(num: float) -> Quantized:
            kept = np.sort(worst_first[int(num) :])
            return quantize(select_rows(exact, kept), classes[kept], rules, state.chunks[kept])

        def is_too_large(num: float) -> bool:
            return count_bytes(without(num)) > 1e6 * self.config.size_mb

        most, dropped, frames = len(worst_first) - 1, 0, np.arange(len(self.frames))
        spread = max(most / 200, 1.0)  # how finely the number is searched
        if self.config.psnr is not None:
            reaches = lambda num: self._psnr(dequantize(without(num)), frames) >= self.config.psnr  # noqa: E731
            dropped = int(_last(reaches, 0, most, spread))
        if self.config.size_mb is not None and is_too_large(dropped):
            dropped = min(int(_last(is_too_large, dropped, most, spread) + spread), most)
        return without(dropped) if dropped else whole

    def _adaptation(self, state: FitState, action: Action) -> float:
        """How much of what an action costs the rest of the fit makes up for, compared with many passes, 0 to 1."""
        if action.progress == 1:
            return 0.0  # although the fit may end before its plan
        return min(self._count_passes(state.plan - state.step) / _PASSES, 1.0)

    def _count_passes(self, steps: int) -> float:
        passes = count_passes(self.config, len(self.frames), steps)
        return passes if self.config.minutes is None else _SPEEDUP * passes

    def _model(self, state: FitState, fps: float = 25.0) -> VideoModel:
        return to_model(state, self.config, self.frames.shape[1:3], fps)

    def _keep_in_chunks(self, state: FitState, order: np.ndarray, chunks: np.ndarray) -> None:
        state.keep(order)
        state.chunks = chunks.astype(np.uint16)

    def _count_missing(self, state: FitState, action: Action) -> int:
        """How many Gaussians a PSNR needs besides those that there are; 0 if the rest of the fit may reach it alone."""
        config, num, shape = self.config, state.num_gaussians, self.frames.shape[:3]
        if config.psnr is None or action.progress > _ADDED_UNTIL or not errors_are_known(state, config):
            return 0
        gain = self._gain(state, action) * (2 if action.progress < _TRUSTED_FROM else 1)
        missing = config.psnr + _MARGIN_DB - self._psnr(self._model(state), self.sampled) - gain
        part = 1.0 if action.progress < _TRUSTED_FROM else self._adaptation(state, action)  # of those that converge
        needed = num * 2 ** (part * min(max(missing, 0.0), 1.0))  # as if twice as many raised it by 1 dB
        most = 2 * START_PER_TIME * time_per_pixel(config, *shape) * math.prod(shape)
        if config.size_mb is not None:
            most = min(most, self._count_held(action))
        if config.quality is not None:
            most = min(most, self._usual_cost(state, action) / (bit_price(coarseness_of(config.quality)) * USUAL_BITS))
        return round(min(needed, most, most_gaussians(config))) - num

    def _drop(self, state: FitState, action: Action) -> None:
        missing = self._count_missing(state, action)
        if missing > 0:
            state.coarseness = state.coarseness or FINEST
            add(missing, state, self.frames, self.config, self.find_motion())
            return
        model = self._model(state)
        worth = Worth(model, self.background)
        coarseness = self._choose_coarseness(state, worth, action)
        if not (state.rules or _is_given(state)):
            state.coarseness = (
                coarseness if self.config.psnr is None else max(coarseness, state.coarseness - _MOST_FINER)
            )
        kept = worth.are_worth(coarseness, action.extent)
        least = math.ceil(_LEAST_KEPT * len(kept))
        kept[np.argsort(worth.removal, kind="stable")[-least:]] = True
        state.keep(np.flatnonzero(kept))
        if self.config.psnr is not None:
            state.last_drop = tuple(self._psnr(one, self.sampled) for one in (model, self._model(state)))

    def _round(self, state: FitState, action: Action) -> None:
        """Round a fraction of the Gaussians; those that are rounded already are among them."""
        if not state.rules:
            self._choose_rules(state, action)
        num, bit = state.num_gaussians, GROUPS[action.what]
        rank = make_generator(Stream.ROUNDING_ORDER, seed=self.config.seed).permutation(num) / num
        rounded = state.rounded | np.where(rank < action.extent, np.uint8(bit), np.uint8(0))
        splats = round_groups(self._model(state), state.classes.astype(np.int32), _decode_rules(state), rounded)
        rows, first, second = pack(splats), state.first.copy(), state.second.copy()
        newly = (rounded != state.rounded)[:, None]
        for name in action.what:  # Adam does not move what has neither a gradient nor moments
            at = columns(self.config.fold_degree)[name]
            for moments in (first, second):
                moments[:, at] = np.where(newly, np.float32(0), moments[:, at])
        state.rows, state.first, state.second, state.rounded = rows, first, second, rounded

    def _choose_rules(self, state: FitState, action: Action) -> None:
        quantizer = Quantizer(self._model(state), self.background)
        state.coarseness = self._choose_coarseness(state, quantizer, action)
        rules = quantizer.make_rules(state.coarseness)
        state.rules = tuple((name, rule.origin, rule.exponent, rule.slopes) for name, rule in rules.items())
        state.classes = quantizer.classes.astype(np.int8)

    def _choose_coarseness(self, state: FitState, measured: Worth | Quantizer, action: Action) -> float:
        """The coarsest that quality, size and PSNR ask for; `measured`: a `Worth` to drop by, or a quantizer."""
        config, wanted = self.config, []
        if config.quality is not None:
            wanted.append(coarseness_of(config.quality))
        if config.psnr is not None:
            wanted.append(self._solve_psnr(state, measured, action))
        if config.size_mb is not None:
            wanted.append(self._solve_size(state, measured, action))
        return min(max(wanted), COARSEST)

    def _solve_size(self, state: FitState, measured: Worth | Quantizer, action: Action) -> float:
        """The coarseness for the largest file: by the number of Gaussians that it holds, and for rounding by coding."""
        if action.what == "drop":
            return max(measured.coarseness_for(self._count_held(action), action.extent), FINEST)
        streams = max(1e6 * self.config.size_mb - HEADER_BYTES, 64.0)

        @functools.cache
        def excess(coarseness: float) -> float:
            begun = time.perf_counter()
            num_bytes = count_bytes(measured.quantize(coarseness, state.chunks)) - HEADER_BYTES
            self.trimming["size_mb"] = _TRIALS * (time.perf_counter() - begun)
            return math.log2(num_bytes / streams)

        if excess(COARSEST) > 0:
            return COARSEST
        return FINEST if excess(FINEST) <= 0 else brentq(excess, FINEST, COARSEST, xtol=_TOLERANCE_OF_SIZE)

    def _count_held(self, action: Action) -> float:
        """The number of Gaussians that are kept for the largest file: at first more than it holds."""
        room = max(1e6 * self.config.size_mb - HEADER_BYTES, 0.0)
        return 8 * room / USUAL_BITS / math.sqrt(action.extent)

    def _solve_psnr(self, state: FitState, measured: Worth | Quantizer, action: Action) -> float:
        """The coarseness for the PSNR that is asked for.

        Gaussians are dropped by what they are worth, as in usual fits. The PSNR bounds this: dropping costs no more
        than `Action.gain` makes up for, and no less than a fraction of it, `_SURE`, does. Rounding is about as
        coarse as dropping.
        """
        aim, drops = self.config.psnr + _MARGIN_DB, action.what == "drop"
        adaptation = self._adaptation(state, action)
        gain = self._gain(state, action)
        now = self._psnr(self._with_only(state, np.ones(state.num_gaussians, bool)), self.sampled)

        def coarsest(most: float, low: float, high: float) -> float:
            """The coarsest one at which the action costs at most `most` dB at once, or less if few passes follow."""
            least = min(now - adaptation * most, aim if drops else aim - adaptation * gain)

            def is_reached(coarseness: float) -> bool:
                if drops:
                    changed = self._with_only(state, measured.are_worth(coarseness, action.extent))
                else:
                    changed = dequantize(measured.quantize(coarseness))
                return self._psnr(changed, self.sampled) >= least

            return _last(is_reached, low, max(low, min(high, COARSEST)))

        if not drops:
            low = max(state.coarseness - _MOST_FINER, FINEST)
            high = state.coarseness + (now + gain - aim) / _DB_PER_UNIT if state.coarseness else COARSEST
            found = coarsest(_MOST_ROUNDED_DB, low, high)
            return found if found > low else coarsest(_MOST_ROUNDED_DB, FINEST, low)
        most = _most_dropped_db(state, self._psnr(self._model(state), self.sampled))
        sure_gain = gain if state.rules else _SURE * gain
        sure = coarsest(min(2 * (now + sure_gain - aim), most), _LEAST_DROPPED, COARSEST)
        if state.rules:
            return sure
        spare = max(2 * (now + gain - aim), _RISKED_DB if action.progress < _TRUSTED_FROM else 0.0)
        return coarsest(min(spare, most), sure, self._usual_coarseness(state, measured, action))

    def _gain(self, state: FitState, action: Action) -> float:
        gain = min(action.gain, _GAIN_OF_GIVEN) if _is_given(state) else action.gain
        return gain * float((self._seen_errors(state) > _PERFECT).mean())  # the PSNR of perfect frames does not rise

    def _with_only(self, state: FitState, kept: Bool[np.ndarray, " num"]) -> VideoModel:
        """The model of some Gaussians, as rounded as it will be once the rules are chosen."""
        model = self._model(state)
        if not state.rules:
            return dataclasses.replace(model, splats=model.splats.take(kept))
        classes, rules = state.classes[kept].astype(np.int32), _decode_rules(state)
        return dequantize(quantize(select_rows(compute_columns(model), kept), classes, rules))

    def _usual_coarseness(self, state: FitState, worth: Worth, action: Action) -> float:
        """The coarseness at which the bits of what is kept have the usual cost."""
        grid = np.arange(FINEST, COARSEST, _TOLERANCE)
        kept = [worth.are_worth(coarseness, action.extent).sum() for coarseness in grid]
        costs = [bit_price(coarseness) * USUAL_BITS * num for coarseness, num in zip(grid, kept, strict=True)]
        limit = self._usual_cost(state, action)
        return float(grid[np.argmax(np.minimum(costs, limit))])  # the first of enough, or the most

    def _usual_cost(self, state: FitState, action: Action) -> float:
        """The cost of the bits of a usual file of the PSNR that is asked for: a multiple of its error.

        Where the error falls as a power of the bits, D ~ R^-b, the best file has lambda R = b D.
        """
        part = _USUAL_COST * min(self._count_passes(state.plan) / _USUAL_PASSES, 1.0)
        # All frames are assumed to differ by as many dB from now.
        least = max(_PERFECT, _error_at(self.config.psnr + _MOST_OVER_DB))
        typical = np.mean(-10 * np.log10(np.maximum(self._seen_errors(state), least)))
        missing = self.config.psnr - typical + running_psnr(state)
        return part * action.extent**_COST_POWER * 255**2 * _error_at(missing) * self.frames[..., :3].size

    def _seen_errors(self, state: FitState) -> Float[np.ndarray, " seen"]:
        """The mean squared errors of the frames that were seen. If none was, the running error."""
        errors = state.frame_errors.astype(float)
        # After two passes, 0 is the error of a perfect frame; before, that of a frame which was not seen yet.
        is_seen = (errors != 0) | (state.step * self.config.views.batch_size >= 2 * len(errors))
        return errors[is_seen] if is_seen.any() else np.array([10 ** (-0.1 * running_psnr(state))])

    def _psnr(self, model: VideoModel, which: Int[np.ndarray, " some"]) -> float:
        """Mean PSNR of the frames `which`, dB; with alpha the lower one of each over black and over white.

        None counts with more than `_MOST_OVER_DB` above a PSNR that is asked for.
        """
        begun = time.perf_counter()
        times = np.asarray(model.frame_times.times())[which]
        found = []
        for background in (BLACK, WHITE) if self.frames.shape[-1] == 4 else (BLACK,):
            images = VideoRenderer(model, background=background).frames(times)
            targets = (self._target(k, background) for k in which)
            found.append([psnr_of(target, image) for target, image in zip(targets, images, strict=True)])
        each = (time.perf_counter() - begun) / len(which)
        self.trimming["psnr"] = _TRIALS * each * len(self.frames)
        most = math.inf if self.config.psnr is None else self.config.psnr + _MOST_OVER_DB
        return float(np.minimum(np.min(found, axis=0), most).mean())

    def _target(self, k: int, background: Background) -> np.ndarray:
        frame = self.frames[k]
        return frame if frame.shape[-1] == 3 else composite(frame, np.float32(background))


def coarseness_of(quality: float) -> float:
    """The binary logarithm of the factor of all steps at a quality."""
    return COARSEST + (FINEST - COARSEST) * quality / 100


def count_bytes(quantized: Quantized) -> int:
    """The bytes of a file, rather too many: its header is not made."""
    streams, info = encode_motion(quantized), quantized.info
    for chunk in quantized.chunks:
        streams += encode_chunk(chunk, quantized.rules, info)
    per_chunk = BYTES_PER_CHUNK + BYTES_PER_STREAM * len(info.column_names)
    header = HEADER_BYTES + BYTES_PER_DEGREE * max(info.degree - 1, 0)
    return header + per_chunk * len(quantized.chunks) + sum(map(len, streams))


def count_past(progress: float) -> int:
    """The number of actions before a fraction of the plan."""
    return sum(action.progress < progress for action in ACTIONS)


def _last(holds: Callable[[float], bool], low: float, high: float, tolerance: float = _TOLERANCE) -> float:
    """About the largest number from `low` to `high` up to which a condition holds; `low` if it does nowhere."""
    if high <= low or not holds(low):  # far beyond, a clip with empty frames may have them perfect again
        return low
    if holds(high):
        return high
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _error_at(psnr: float) -> float:
    return 10 ** (-0.1 * psnr)


def _most_dropped_db(state: FitState, psnr: float) -> float:
    """How many dB dropping may cost at once. It is less if error of the last dropping remains at this PSNR."""
    if not state.last_drop:
        return _FIRST_DROPPED_DB
    before, after, now = map(_error_at, (*state.last_drop, psnr))
    left = (now - before) / (after - before) if state.last_drop[0] - state.last_drop[1] >= _LEAST_MEASURED_DB else 0.0
    return _MOST_DROPPED_DB * (1 - min(max(left, 0.0), 1.0)) ** 2


def _is_given(state: FitState) -> bool:
    """Whether the fit began with a finished model; known until rules are chosen."""
    return not state.coarseness and state.rate_actions > 0


def _decode_rules(state: FitState) -> dict[str, Rule]:
    return {name: Rule(*numbers) for name, *numbers in state.rules}
