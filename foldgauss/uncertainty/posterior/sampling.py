"""Frame times drawn from their posterior by emcee."""

import contextlib
import copy
import dataclasses
import errno
import hashlib
import importlib
import importlib.metadata
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64, UInt8

from foldgauss._runtime.checks import check_signature, invalid, is_integer, is_within, short_repr
from foldgauss._runtime.file_lock import LockHeld, hold_lock
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, evidence
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.posterior.exact import ExactTimes, exact_times
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.uncertainty.posterior.laplace import LaplaceTimes, laplace_times
from foldgauss.uncertainty.posterior.log_prob import (
    DEFAULT_NOISE,
    FrameTimeLogProb,
    at_level,
    check_asked,
    check_seen,
    frame_time_log_prob,
)
from foldgauss.video.models.video_model import VideoModel

if TYPE_CHECKING:
    import arviz

#: Sampling has converged with so many autocorrelation times kept, and split rank R-hat below this.
TIMES_TAU, R_HAT = 50.0, 1.01
#: Means of draws are at most so many standard deviations from the exact ones, and so many Monte Carlo errors.
APART, ERRORS = 0.1, 5.0
#: Thrown away at the start: so many autocorrelation times.
BURN_IN = 10.0
#: Steps per one that is kept; kept steps between two looks at convergence.
THIN, LOOK = 10, 50
#: Up to so many free frames emcee's own moves take all at once, besides blocks of frames; beyond, blocks alone do.
AT_ONCE = 12
#: Frames whose draws are looked at together: a copy of these is made, and not of all.
TOGETHER = 64


@dataclasses.dataclass(frozen=True, repr=False)
class FrameTimePosterior:
    r"""Draws of frame times, and how far to trust them.

    **Shapes:** `times` (ensembles, steps, walkers, num_frames) after burn-in; `acceptance` (ensembles,), the mean share
    of proposals accepted; `tau`, `r_hat`, `ess` (num_free,) in the order of `free`: integrated autocorrelation time in
    steps of the sampler, split rank R-hat over the ensembles, and effective sample size.

    `converged`: more than 50 tau of every frame, every R-hat < 1.01, and every mean within 0.1 + 5 / sqrt(ess) standard
    deviations of the exact one: ensembles that all miss the same hill agree with each other. `message` says so, or what
    is missing, and how many frames tell their time where some do not (`identified`).
    `laplace`, `exact`: the same posterior by Laplace's approximation and by forward and backward passes.

    **Source:** emcee, Foreman-Mackey et al. 2013; R-hat, Vehtari et al. 2021. The walkers of one ensemble depend on
    each other, so each ensemble is one chain; ESS is steps times walkers over tau.
    """

    log_prob: FrameTimeLogProb
    times: Float64[np.ndarray, "ensembles steps walkers num_frames"]
    acceptance: Float64[np.ndarray, " ensembles"]
    tau: Float64[np.ndarray, " num_free"]
    r_hat: Float64[np.ndarray, " num_free"]
    ess: Float64[np.ndarray, " num_free"]
    converged: bool
    message: str
    laplace: LaplaceTimes
    exact: ExactTimes
    seen: LikelihoodProfiles | None = None

    def __repr__(self) -> str:
        ensembles, steps, walkers, frames = self.times.shape
        shape = f"{len(self.free)} of {frames} times, {ensembles} x {steps} x {walkers} draws"
        return f"{type(self).__name__}({shape}: {self.message})"

    @property
    def free(self) -> np.ndarray:
        """The frames whose times were drawn."""
        return np.flatnonzero(self.log_prob.increments.free)

    @property
    def draws(self) -> Float64[np.ndarray, "draws num_frames"]:
        """All draws of all ensembles."""
        return self.times.reshape(-1, self.times.shape[-1])

    @property
    def logits(self) -> Float64[np.ndarray, "ensembles steps walkers intervals"]:
        """The model's softmax weights w of all draws, centred."""
        return self.log_prob.increments.logits(self.times)

    def mean(self) -> Float64[np.ndarray, " num_frames"]:
        return self.times.mean((0, 1, 2))

    def std(self) -> Float64[np.ndarray, " num_frames"]:
        return self._by_frames(lambda draws: draws.std(0))

    def interval(self, level: float = 0.9) -> Float64[np.ndarray, "2 num_frames"]:
        """Ends of the central intervals that hold `level` of the draws."""
        if not is_within(level, "(0, 1)"):
            raise invalid("level", expected="a number in (0, 1)", got=short_repr(level))
        ends = [(1 - level) / 2, (1 + level) / 2]
        return self._by_frames(lambda draws: np.quantile(draws, ends, axis=0))

    def _by_frames(self, found: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """What is `found` of draws (draws, frames), some frames at a time: no copy of all."""
        num_frames = self.times.shape[-1]
        parts = [self.times[..., first : first + TOGETHER] for first in range(0, num_frames, TOGETHER)]
        return np.concatenate([found(part.reshape(-1, part.shape[-1])) for part in parts], axis=-1)

    def identified(self, share: float = 0.8) -> np.ndarray:
        """Which frames tell their time: bool (num_frames,); there the posterior is narrower than `share` of the prior.

        The prior's spread is that of a frame between two others at the posterior's mean; frames held count as told.
        """
        mean, alpha = self.mean(), self.log_prob.increments.concentration
        told = np.ones(len(mean), bool)
        gap = mean[2:] - mean[:-2]
        told[1:-1] = self.std()[1:-1] < share * gap * np.sqrt(0.25 / (2 * alpha + 1))
        return told | ~self.log_prob.increments.free

    def to_arviz(self) -> "arviz.InferenceData":
        """Draws as ArviZ knows them: a chain an ensemble, its walkers one after another within every step.

        Posterior: `t` (chain, draw, frame) and `w` (chain, draw, interval), centred. Sample statistics: `lp`.
        """
        arviz = needed("arviz")
        ensembles, steps, walkers, num_frames = self.times.shape
        flat = self.times.reshape(ensembles, steps * walkers, num_frames)
        increments = self.log_prob.increments
        lp = np.stack([self.log_prob(increments.coordinates(each)) for each in flat])
        return arviz.from_dict(
            posterior={"t": flat, "w": increments.logits(flat)},
            sample_stats={"lp": lp},
            coords={"frame": np.arange(num_frames), "interval": np.arange(num_frames - 1)},
            dims={"t": ["frame"], "w": ["interval"]},
            attrs={"converged": int(self.converged), "message": self.message},
        )


def frame_time_posterior(
    model: VideoModel | None = None,
    video: UInt8[np.ndarray, "num_frames height width channels"] | None = None,
    *,
    frames: Sequence[int] | None = None,
    walkers: int | None = None,
    steps: int = 20_000,
    moves: Any = None,
    seed: int = 0,
    progress: bool | Callable[[str, int, int], None] = True,
    noise: str | FrameNoise = DEFAULT_NOISE,
    level: str = "splats",
    concentration: float = 1.0,
    ensembles: int = 4,
    thin_by: int = THIN,
    backend: str | os.PathLike | None = None,
    seen: LikelihoodProfiles | None = None,
    log_prob: FrameTimeLogProb | None = None,
) -> FrameTimePosterior:
    """Draw the times of `frames` (default: of all but the first and the last) from their posterior, given the splats.

    Independent emcee ensembles of `walkers` each, started from Laplace's approximation, run until more than 50
    autocorrelation times of every frame are kept, split rank R-hat is below 1.01 for all and means agree with the exact
    passes, or for `steps` steps, of which every `thin_by`-th is kept. Many frames move by `BlockSweep`, a few by that
    and by emcee's differential evolution and stretch moves; or by `moves`, as `emcee.EnsembleSampler` takes them, all
    frames at once.

    `noise`, `level`, `concentration`, `video`, `seen`: see `frame_time_log_prob`, whose result may be handed in as
    `log_prob`, in place of these and of `model` and `frames`; beside it `seen` is only kept, for summaries.
    `progress`: a bar, or a function of (what, done, of how many). `backend`: an HDF5 file to which all is written as
    it goes; called again with the same arguments, sampling goes on where it stopped, to the same bits.

    **Memory:** 16 bytes a kept time, half of which stay: ensembles x (steps / thin_by) x walkers x frames. 2,000 frames
    by 4 x 32 walkers, 1,000 kept steps: 4 GB, 2 GB of them to stay. A greater `thin_by` takes less; with a `backend`
    the first half is on disk but for one ensemble at a time.

    Raises ValueError, before any picture is drawn, for fewer walkers than twice the frames that move at once, settings
    out of range or given beside what they would contradict, and a backend that cannot be written; later for a backend
    of another run, a NaN log-probability, and whatever `frame_time_log_prob` refuses; BlockingIOError, before any
    picture, where another run is writing the backend; ImportError without emcee.

    Example: `frame_time_posterior(model, frames).interval(0.9)`.
    """
    needed("emcee")
    needed("arviz")
    given = {"model": model, "video": video, "frames": frames}
    free = _free_of(log_prob, seen, given, noise, level, concentration)
    _check_progress(progress)
    moves = None if moves is None else _checked_moves(moves)
    settings = _Settings(
        check_settings(free.num_free, walkers, ensembles=ensembles, steps=steps, thin_by=thin_by, together=bool(moves)),
        _checked_seed(seed),
        int(ensembles),
        int(thin_by),
        moves,
        _checked_backend(backend),
    )
    with only_run(settings.backend), _shown(progress) as show:
        if log_prob is None:
            look = None if show is None else (lambda done, total: show("pictures", done, total))
            if seen is None:
                seen = evidence(model, video, noise=noise, on_picture=look)
            look = None if show is None else (lambda done, total: show("frames", done, total))
            seen = at_level(level, model, video, seen, frames, look)
            log_prob = frame_time_log_prob(model, frames=frames, concentration=concentration, seen=seen)
        return _Run(log_prob, settings).until_converged(int(steps) // int(thin_by), show, seen)


def _free_of(
    log_prob, seen: LikelihoodProfiles | None, given: dict[str, Any], noise, level: str, concentration
) -> Increments:
    """Which frames are free; ValueError for what contradicts, is missing or cannot be right."""
    if log_prob is None:
        if given["model"] is None:
            raise invalid("model", expected="a VideoModel, or a `log_prob`", got=None)
        return check_asked(given["model"], given["video"], noise, level, given["frames"], concentration, seen)
    if not isinstance(log_prob, FrameTimeLogProb):
        raise invalid("log_prob", expected="what `frame_time_log_prob` gives", got=short_repr(log_prob))
    defaults = {"noise": (noise, DEFAULT_NOISE), "level": (level, "splats"), "concentration": (concentration, 1.0)}
    beside = [name for name, value in given.items() if value is not None]
    beside += [name for name, (value, usual) in defaults.items() if type(value) is not type(usual) or value != usual]
    if beside:
        cure = "Give them to `frame_time_log_prob`, or leave `log_prob` out."
        raise invalid(
            beside[0], expected="nothing beside `log_prob`, which has its own", got=", ".join(beside), cure=cure
        )
    if seen is not None and (num := check_seen(seen, None)) != log_prob.profiles.num_frames:
        expected = f"what was seen of the {log_prob.profiles.num_frames} frames of `log_prob`"
        raise invalid("seen", expected=expected, got=f"{num} frames")
    return log_prob.increments


def check_settings(
    num_free: int,
    walkers: int | None = None,
    *,
    ensembles: int = 4,
    steps: int | None = None,
    thin_by: int = THIN,
    together: bool = False,
) -> int:
    """The number of walkers, or its default, for `num_free` frames whose settings can be right.

    `together`: all frames move at once. Raises ValueError as `frame_time_posterior` does, before any work.
    """
    from foldgauss.uncertainty.posterior.moves import BLOCK

    at_once = num_free if together or num_free <= AT_ONCE else BLOCK
    found = max(32, 4 * at_once) if walkers is None else walkers
    if not is_integer(found, max(2 * at_once, 4)) or found % 2:
        expected = f"an even number, at least {max(2 * at_once, 4)}: twice the frames that move at once"
        cure = "Leave it out, or choose fewer frames."
        raise invalid("walkers", expected=expected, got=short_repr(walkers), cure=cure)
    if not is_integer(ensembles, 2):
        expected = "at least 2 (a whole number), better 4: R-hat compares them"
        raise invalid("ensembles", expected=expected, got=short_repr(ensembles))
    if not is_integer(thin_by, 1):
        raise invalid("thin_by", expected="a whole number >= 1", got=short_repr(thin_by))
    if steps is not None and not is_integer(steps, int(thin_by)):
        raise invalid("steps", expected=f"at least thin_by = {thin_by}, a whole number", got=short_repr(steps))
    return int(found)


def _checked_seed(seed: int) -> int:
    if not is_integer(seed, 0):
        raise invalid("seed", expected="a whole number >= 0", got=short_repr(seed))
    return int(seed)


def _checked_moves(moves) -> list[tuple[Any, float]]:
    """Copies of moves and their weights, from any of the forms that `emcee.EnsembleSampler` takes."""
    expected = "an emcee move, a list of moves, or a list of (move, weight)"
    if _is_move(moves):
        pairs = [(moves, 1.0)]
    elif isinstance(moves, list | tuple) and moves and all(map(_is_move, moves)):
        pairs = [(move, 1.0) for move in moves]
    elif isinstance(moves, list | tuple) and moves and all(map(_is_weighted, moves)):
        pairs = [(move, float(weight)) for move, weight in moves]
    else:
        cure = "A class is called first: `StretchMove()`." if "class" in repr(moves) else ""
        raise invalid("moves", expected=expected, got=short_repr(moves), cure=cure)
    if not sum(weight for _, weight in pairs) > 0:
        raise invalid("moves", expected="weights of which one is above 0", got=[weight for _, weight in pairs])
    if any(type(move).__name__ == "DESnookerMove" for move, _ in pairs) and _version("emcee") < (3, 1, 7):
        cure = "Its proposals are scaled wrongly (emcee pull request 531): take DEMove, or a later emcee."
        expected = "moves that draw what they should"
        raise invalid("moves", expected=expected, got="DESnookerMove of emcee 3.1", cure=cure)
    # A move notes things of its run in itself, which are no settings.
    return [(copy.copy(move), weight) for move, weight in pairs]


def _is_move(value) -> bool:
    return callable(getattr(value, "propose", None)) and not isinstance(value, type)


def _is_weighted(value) -> bool:
    return (
        isinstance(value, list | tuple) and len(value) == 2 and _is_move(value[0]) and is_within(value[1], "[0, inf)")
    )


def _checked_backend(backend) -> Path | None:
    """A file that may be written; whose run it holds is seen later."""
    if backend is None:
        return None
    needed("h5py")
    if not isinstance(backend, str | os.PathLike) or not os.fspath(backend):
        raise invalid("backend", expected="the path of an HDF5 file, or None", got=short_repr(backend))
    path = Path(backend)
    if not path.parent.is_dir():
        raise invalid(
            "backend", expected="a file in a folder that exists", got=str(path), cure="Make the folder first."
        )
    if path.is_dir():
        raise invalid("backend", expected="a file", got=f"the folder {path}")
    if not os.access(path.parent, os.W_OK):
        raise invalid("backend", expected="a folder that can be written to", got=str(path.parent))
    if path.exists():
        _fingerprint_of(path)
    return path


@contextlib.contextmanager
def only_run(backend: Path | None) -> Iterator[None]:
    """Keep other runs from writing the file, until the block or the process ends, however it does.

    Raises BlockingIOError at once where another one is writing it, of this process too.
    """
    with contextlib.ExitStack() as stack:
        if backend is not None:
            try:
                stack.enter_context(hold_lock(_running(backend, ".lock")))
            except LockHeld as error:
                raise BlockingIOError(
                    f"backend: expected a file that no other run is writing, got {str(backend)!r}, which one is. "
                    "Wait for that one, or choose another file."
                ) from error
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(backend)) from error
        yield


def _running(backend: Path, ending: str = "") -> Path:
    """What lies beside a file of draws while it is written."""
    return backend.with_name(f".{backend.name}.running{ending}")


@dataclasses.dataclass(frozen=True)
class _Settings:
    """Of sampling, checked; `moves` None: the usual ones."""

    walkers: int
    seed: int
    ensembles: int
    thin_by: int
    moves: list[tuple[Any, float]] | None
    backend: Path | None


class _Run:
    """Some independent ensembles, and what they have kept."""

    def __init__(self, log_prob: FrameTimeLogProb, settings: _Settings):
        self.log_prob, self.thin_by, self.seed = log_prob, settings.thin_by, settings.seed
        self.walkers, self.free = settings.walkers, np.flatnonzero(log_prob.increments.free)
        moves = _usual_moves(log_prob) if settings.moves is None else settings.moves
        self.exact = exact_times(log_prob.profiles, log_prob.increments)
        self.laplace = laplace_times(log_prob.profiles, log_prob.increments, self.exact.quantile(0.5))
        fingerprint = self._fingerprint(settings.ensembles, moves)
        shape = settings.ensembles, self.walkers, log_prob.num_free
        self.file = None if settings.backend is None else _Kept(settings.backend, fingerprint, shape)
        self.samplers = [self._sampler(n, moves) for n in range(settings.ensembles)]

    def _fingerprint(self, ensembles: int, moves: list[tuple[Any, float]]) -> str:
        """Of everything that the draws depend on."""
        found, increments = self.log_prob.profiles, self.log_prob.increments
        parts = [found.nodes, found.values, increments.held[~increments.free], increments.free]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        described = [(_described(move), weight) for move, weight in moves]
        settings = increments.concentration, self.walkers, self.seed, ensembles, self.thin_by, described
        digest.update(repr(settings).encode())
        return digest.hexdigest()

    def _sampler(self, n: int, moves):
        import emcee

        kept = emcee.backends.Backend() if self.file is None else self.file.of(n)
        sampler = emcee.EnsembleSampler(
            self.walkers, self.log_prob.num_free, self.log_prob, vectorize=True, moves=moves, backend=kept
        )
        if kept.iteration:
            sampler.start = kept.get_last_sample()
            return sampler
        seeds = np.random.SeedSequence([self.seed, n])
        times = self.laplace.sample(self.walkers, np.random.default_rng(seeds))
        state = emcee.State(self.log_prob.increments.coordinates(times))
        state.random_state = np.random.RandomState(np.random.MT19937(seeds)).get_state()
        sampler.start = state
        return sampler

    def until_converged(self, most: int, show, seen: LikelihoodProfiles | None) -> FrameTimePosterior:
        try:
            return self._until_converged(most, show, seen)
        finally:
            if self.file is not None:
                self.file.close()

    def _until_converged(self, most: int, show, seen: LikelihoodProfiles | None) -> FrameTimePosterior:
        done = min(sampler.iteration for sampler in self.samplers)
        goal = min(LOOK, most)
        while True:
            if done >= min(LOOK, most):
                found = self.result(seen)
                if found.converged or done >= most:
                    if self.file is not None:
                        self.file.keep()
                    return found
                needed = 1.1 * (TIMES_TAU + BURN_IN) * found.tau.max() / self.thin_by
                goal = min(max(int(min(needed, 2 * done)), done + max(LOOK, done // 4)), most)
                del found  # its draws, before there are more
            if self.file is not None:
                left = sum(goal - sampler.iteration for sampler in self.samplers)
                self.file.check_space(8 * left * self.walkers * (self.log_prob.num_free + 1))  # and its log-density
            for n, sampler in enumerate(self.samplers):
                for _ in self._steps(sampler, goal - sampler.iteration):
                    if show is not None:
                        each = [other.iteration for other in self.samplers]
                        show("steps", sum(each) * self.thin_by, len(self.samplers) * goal * self.thin_by)
            done = goal
            if self.file is not None:
                self.file.keep()

    def _steps(self, sampler, num: int) -> Iterator[None]:
        if num <= 0:
            return
        try:
            for state in sampler.sample(
                sampler.start, iterations=num, thin_by=self.thin_by, skip_initial_state_check=True
            ):
                sampler.start = state
                yield
        except (RuntimeError, np.linalg.LinAlgError) as error:
            if self.file is not None:
                self.file.check_room(error)
            raise invalid("moves", expected="moves that these walkers can make", got=str(error)) from error

    def times(self) -> Float64[np.ndarray, "ensembles steps walkers num_frames"]:
        """Of all that is kept, some steps at a time: a copy of all is made once."""
        steps = min(sampler.iteration for sampler in self.samplers)
        increments = self.log_prob.increments
        times = np.empty((len(self.samplers), steps, self.walkers, increments.num_frames))
        for sampler, found in zip(self.samplers, times, strict=True):
            chain = sampler.get_chain()
            for first in range(0, steps, LOOK):
                part = slice(first, min(first + LOOK, steps))
                found[part] = increments.times(chain[part])
        return times

    def result(self, seen: LikelihoodProfiles | None) -> FrameTimePosterior:
        times = self.times()
        steps = times.shape[1]
        tau = np.array([max(_tau(one[..., k]) for one in times) for k in self.free])
        burn = int(min(np.ceil(BURN_IN * tau.max()), steps // 2))
        times = times[:, burn:]
        kept = times.shape[1]
        r_hat = np.array([_r_hat(times[..., k]) for k in self.free])
        acceptance = np.array([np.mean(sampler.acceptance_fraction) for sampler in self.samplers])
        found = FrameTimePosterior(
            self.log_prob,
            times,
            acceptance,
            tau * self.thin_by,
            r_hat,
            kept * self.walkers * len(self.samplers) / tau,
            False,
            "",
            self.laplace,
            self.exact,
            seen,
        )
        wrong = self._wrong(found, kept / tau)
        done = f"onverged after {steps * self.thin_by:,} steps"
        message = f"Not c{done}: {'; '.join(wrong)}. Give more steps." if wrong else f"C{done}."
        told = int(found.identified()[self.free].sum())
        if told < len(self.free):
            message += f" {told} of {len(self.free)} frames {'tells its' if told == 1 else 'tell their'} time."
        return dataclasses.replace(found, converged=not wrong, message=message)

    def _wrong(self, found: FrameTimePosterior, lengths: Float64[np.ndarray, " num_free"]) -> list[str]:
        """What is missing."""
        wrong, free = [], self.free
        if not lengths.min() > TIMES_TAU:
            wrong.append(
                f"{lengths.min():.0f} autocorrelation times kept of frame {free[lengths.argmin()]}, not {TIMES_TAU:.0f}"
            )
        if not found.r_hat.max() < R_HAT:
            wrong.append(f"R-hat {found.r_hat.max():.3f} of frame {free[found.r_hat.argmax()]}, not below {R_HAT}")
        std = np.maximum(self.exact.std()[free], np.finfo(np.float64).tiny)
        apart = np.abs(found.mean() - self.exact.mean())[free] / std
        over = apart - (APART + ERRORS / np.sqrt(found.ess))
        if not over.max() <= 0:
            worst = over.argmax()
            wrong.append(
                f"emcee and the exact passes disagree at frame {free[worst]}, by {apart[worst]:.2g} standard deviations"
            )
        return wrong


def _tau(times: Float64[np.ndarray, "steps walkers"]) -> float:
    """Integrated autocorrelation time in kept steps, at least 1; of what never moves, all of them."""
    import emcee

    with np.errstate(invalid="ignore", divide="ignore"):
        found = float(emcee.autocorr.integrated_time(times[..., None], quiet=True, tol=0)[0])
    return max(found, 1.0) if np.isfinite(found) else float(len(times))


def _r_hat(times: Float64[np.ndarray, "ensembles steps walkers"]) -> float:
    """Split rank R-hat, an ensemble a chain."""
    arviz = needed("arviz")
    return float(arviz.rhat(np.ascontiguousarray(times).reshape(len(times), -1), method="rank"))


def _usual_moves(log_prob: FrameTimeLogProb) -> list[tuple[Any, float]]:
    from emcee.moves import DEMove, StretchMove

    from foldgauss.uncertainty.posterior.moves import BlockSweep

    sweep = BlockSweep(log_prob)
    # emcee's moves alone stay on the hill on which they start; sweeps go from one to another.
    return [(sweep, 0.5), (DEMove(), 0.3), (StretchMove(), 0.2)] if log_prob.num_free <= AT_ONCE else [(sweep, 1.0)]


def _described(value, depth: int = 2) -> Any:
    """A move's kind and its settings: numbers, texts and arrays, and those of what it is made of."""
    if value is None or isinstance(value, bool | str | int | float):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, list | tuple):
        return [_described(each, depth) for each in value]
    kind = getattr(value, "__qualname__", type(value).__qualname__)
    if depth == 0 or isinstance(value, FrameTimeLogProb):  # what is drawn from has its own part of the fingerprint
        return kind
    inner = getattr(value, "__dict__", {})
    return kind, [(name, _described(each, depth - 1)) for name, each in sorted(inner.items())]


#: Room that an HDF5 file of draws takes beside them: of its pieces, the last ones are not full.
SPARE, SPARE_BYTES = 1.2, 4 << 20

#: Bytes before the HDF5 part of a file of draws, and how they begin: with this and the SHA-256 of all that follows.
_BLOCK, _SEAL = 512, b"foldgauss draws, SHA-256 "


class _Kept:
    """An HDF5 file of all ensembles that is whole at any moment: sampling writes beside it, and it is replaced.

    It is sealed by a checksum, without which the HDF5 library never sees it: on a damaged file that may hang.
    """

    def __init__(self, path: Path, fingerprint: str, shape: tuple[int, int, int]):
        """`shape`: ensembles, walkers of each, frames that move."""
        self.path = path
        self.live = _running(path)
        if path.exists():
            kept = _fingerprint_of(path, fingerprint, shape)
            if kept != fingerprint:
                cure = "Choose another file, or give the same model, video and settings."
                raise invalid(
                    "backend", expected="the file of this very run", got=f"{self.path}, of another", cure=cure
                )
        self.check_space(path.stat().st_size if path.exists() else 0)
        with self.written():
            if path.exists():
                _copy_anew(self.path, self.live)
            else:
                self.live.unlink(missing_ok=True)
                with needed("h5py").File(self.live, "x", userblock_size=_BLOCK) as file:
                    file.attrs["fingerprint"] = fingerprint

    def of(self, n: int):
        import emcee

        return emcee.backends.HDFBackend(str(self.live), name=f"ensemble_{n}")

    def keep(self) -> None:
        """What is written so far replaces the file."""
        copy = self.path.with_name(f".{self.path.name}.new")
        try:
            with self.written():
                _copy_anew(self.live, copy)
                _seal(copy)
                os.replace(copy, self.path)
        finally:
            copy.unlink(missing_ok=True)

    def close(self) -> None:
        """Drop what is not kept."""
        self.live.unlink(missing_ok=True)

    def check_space(self, num_bytes: int) -> None:
        """Raise OSError where the disk has no room for so much more, and a copy: HDF5 may crash on one that is full."""
        there = self.live.stat().st_size if self.live.exists() else 0
        room = SPARE * (2 * num_bytes + there) + SPARE_BYTES
        if shutil.disk_usage(self.path.parent).free < room:
            self.check_room(OSError(errno.ENOSPC, f"{room / 1e6:.0f} MB are needed"))

    @contextlib.contextmanager
    def written(self) -> Iterator[None]:
        """Where writing fails for what the system refuses: an OSError that names the file, and nothing beside it."""
        try:
            yield
        except (OSError, RuntimeError) as error:
            self.check_room(error)
            raise

    def check_room(self, error: Exception) -> None:
        """Raise what the system has refused, if it has: HDF5 tells it within a long text, or as a RuntimeError."""
        told = re.search(r"errno = (\d+)", str(error))
        number = int(told[1]) if told else getattr(error, "errno", None)
        if number is None:
            return
        self.live.unlink(missing_ok=True)
        raise OSError(number, os.strerror(number), str(self.path)) from error


def _copy_anew(source: Path, target: Path) -> None:
    """Copy into a new file: what lay there may be a link of a stranger's to any other, and is not followed."""
    target.unlink(missing_ok=True)
    target.touch(exist_ok=False)
    shutil.copyfile(source, target)


def _seal(path: Path) -> None:
    """Write the checksum of what a file holds into its first bytes."""
    with open(path, "r+b") as file:
        file.seek(_BLOCK)
        seal = _SEAL + hashlib.file_digest(file, "sha256").hexdigest().encode()
        file.seek(0)
        file.write(seal)
        file.flush()
        os.fsync(file.fileno())


def is_sealed(path: Path) -> bool:
    """Whether a file of draws is as it was written: what is damaged, or anything else, is not."""
    with open(path, "rb") as file:
        block = file.read(_BLOCK)
        return block.startswith(_SEAL + hashlib.file_digest(file, "sha256").hexdigest().encode())


def _fingerprint_of(path: Path, wanted: str | None = None, shape: tuple[int, int, int] = (0, 0, 0)) -> str:
    """Of the run that a file keeps, which holds all that `wanted` promises. A file may come from a stranger."""
    try:
        if not is_sealed(path):
            raise _damaged(path)
        with needed("h5py").File(path) as file:
            found = file.attrs.get("fingerprint", "")
            complete = isinstance(found, str)
            if complete and found == wanted:
                num, *each = shape
                complete = all(_is_whole(file, f"ensemble_{n}", *each, path.stat().st_size) for n in range(num))
    except Exception as error:  # of what kind depends on where the library finds the damage
        raise _damaged(path) from error
    if not complete:
        raise _damaged(path)
    return found


def _damaged(path: Path) -> ValueError:
    cure = "Remove it, or choose another."
    return invalid("backend", expected="a file of draws, or none yet", got=f"{path}, damaged", cure=cure)


def _is_whole(file, name: str, walkers: int, free: int, size: int) -> bool:
    """Whether an ensemble is as emcee wrote it, in this file, of so many bytes: it reads no more than those."""
    h5py = needed("h5py")
    links = [name, *(f"{name}/{part}" for part in ("chain", "log_prob", "accepted"))]
    if not all(isinstance(file.get(link, getlink=True), h5py.HardLink) for link in links):
        return False
    group, *parts = (file[link] for link in links)
    done, rows = group.attrs["iteration"], parts[0].shape[0]
    shapes = (rows, walkers, free), (rows, walkers), (walkers,)
    for part, want in zip(parts, shapes, strict=True):
        plain = part.dtype == np.float64 and part.external is None and not part.is_virtual and part.compression is None
        if not (plain and part.shape == want and part.id.get_storage_size() <= size):
            return False
    told = [group.attrs[fact] for fact in ("nwalkers", "ndim")]
    numbers = (
        is_integer(done, 0) and all(is_integer(fact, 0) for fact in told) and np.shape(group.attrs["has_blobs"]) == ()
    )
    if not numbers or done > rows or told != [walkers, free] or bool(group.attrs["has_blobs"]):
        return False
    needs = 8 * int(done) * walkers * free, 8 * int(done) * walkers
    if any(part.id.get_storage_size() < need for part, need in zip(parts[:2], needs, strict=True)):
        return False
    return done == 0 or (bool(np.isfinite(parts[0][done - 1]).all()) and _is_random_state(group.attrs))


def _is_random_state(attributes) -> bool:
    """Whether NumPy may be handed it: it trusts the place within its numbers."""
    kind, keys, place, has_one, one = (attributes[f"random_state_{k}"] for k in range(5))
    numbers = is_integer(place, 0) and place <= 624 and is_integer(has_one, 0) and has_one <= 1
    return (
        numbers
        and isinstance(one, float)
        and np.isfinite(one)
        and isinstance(kind, str)
        and (kind, keys.shape, keys.dtype) == ("MT19937", (624,), np.uint32)
    )


def needed(name: str):
    """An optional package, or what to install."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # ArviZ announces its next version
            return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{name} is needed here: pip install 'foldgauss[uncertainty]'") from error


def _version(name: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", importlib.metadata.version(name))[:3])


def _check_progress(progress) -> None:
    if progress is None or isinstance(progress, bool):
        return
    if not callable(progress):
        raise invalid("progress", expected="True, False or a function", got=short_repr(progress))
    check_signature("progress", progress, "what", "done", "total")


@contextlib.contextmanager
def _shown(progress) -> Iterator[Callable[[str, int, int], None] | None]:
    """A function that shows how far things are, or None."""
    if progress is None or progress is False:
        yield None
        return
    if progress is not True:
        yield progress
        return
    from rich.progress import Progress

    with Progress(transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what.capitalize(), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield show
