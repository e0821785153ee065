"""Sampling of the posterior of frame times by emcee: ensembles, convergence, resumption from a file."""

import contextlib
import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from foldgauss._numerics.random_streams import Stream, seed_sequence
from foldgauss._runtime.checks import invalid, short_repr
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles, likelihood_profiles
from foldgauss.uncertainty.likelihood.noise import FrameNoise
from foldgauss.uncertainty.posterior.draws_file import DrawsFile, lock_draws
from foldgauss.uncertainty.posterior.exact import exact_posterior
from foldgauss.uncertainty.posterior.increments import Increments
from foldgauss.uncertainty.posterior.laplace import laplace_approximation
from foldgauss.uncertainty.posterior.log_prob import (
    DEFAULT_NOISE,
    FrameTimeLogProb,
    check_profiles,
    check_request,
    condition_on_level,
    frame_time_log_prob,
)
from foldgauss.uncertainty.posterior.optional_imports import import_optional
from foldgauss.uncertainty.posterior.result import FrameTimePosterior
from foldgauss.uncertainty.posterior.settings import (
    AT_ONCE,
    THIN,
    SamplerSettings,
    check_backend,
    check_moves,
    check_progress,
    check_seed,
    check_settings,
)
from foldgauss.video.models.video_model import VideoModel

#: Convergence: at least this many autocorrelation times kept, and split rank R-hat below this.
TIMES_TAU, R_HAT = 50.0, 1.01
#: Convergence: means differ from the exact ones by at most APART standard deviations plus ERRORS standard errors.
APART, ERRORS = 0.1, 5.0
#: Burn-in, in autocorrelation times.
BURN_IN = 10.0
#: Kept steps between two checks of convergence.
CHECK_EVERY = 50


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
    profiles: LikelihoodProfiles | None = None,
    log_prob: FrameTimeLogProb | None = None,
) -> FrameTimePosterior:
    """Sample the times of `frames` (default: all but the first and the last) from their posterior given the splats.

    Independent emcee ensembles of `walkers` each, started from Laplace's approximation, run until more than 50
    autocorrelation times of every frame are kept, split rank R-hat is below 1.01 for all and the means agree with the
    exact ones, or for `steps` steps, of which every `thin_by`-th is kept. The default moves are `BlockSweep` and, for
    few frames, emcee's differential evolution and stretch moves; `moves`, as `emcee.EnsembleSampler` accepts them,
    replace these and update all frames at once.

    `noise`, `level`, `concentration`, `video`, `profiles`: see `frame_time_log_prob`, whose result may be given as
    `log_prob` in place of these and of `model` and `frames`; `profiles` beside it are only kept, for summaries.
    `progress`: whether to show a bar, or a function of (what, done, total). `backend`: an HDF5 file to which the draws
    are written; called again with the same arguments, sampling resumes and gives the same bits.

    **Memory:** 16 bytes per kept time (ensembles x (steps / thin_by) x walkers x frames), of which half stay allocated;
    with a `backend` the first half is on disk except for one ensemble at a time.

    Raises ValueError before any image is rendered for fewer walkers than twice the frames that move at once, settings
    out of range or in conflict with each other, and a backend that cannot be written; later for a backend of another
    run, a NaN log-probability, and whatever `frame_time_log_prob` raises; BlockingIOError if another run is writing
    the backend; ImportError without emcee.

    Example: `frame_time_posterior(model, frames).interval(0.9)`.
    """
    import_optional("emcee")
    import_optional("arviz")
    given = {"model": model, "video": video, "frames": frames}
    increments = _check_arguments(log_prob, profiles, given, noise, level, concentration)
    check_progress(progress)
    moves = check_moves(moves)
    num_walkers = check_settings(
        increments.num_free, walkers, ensembles=ensembles, steps=steps, thin_by=thin_by, together=bool(moves)
    )
    seed, backend = check_seed(seed), check_backend(backend)
    settings = SamplerSettings(num_walkers, seed, int(ensembles), int(thin_by), moves, backend)
    with lock_draws(settings.backend), _progress_function(progress) as show:
        if log_prob is None:
            if profiles is None:
                profiles = likelihood_profiles(model, video, noise=noise, on_render=_labeled(show, "images"))
            profiles = condition_on_level(level, model, video, profiles, frames, _labeled(show, "frames"))
            log_prob = frame_time_log_prob(model, frames=frames, concentration=concentration, profiles=profiles)
        run = _Run(log_prob, settings)
        with contextlib.nullcontext() if run.file is None else contextlib.closing(run.file):
            return run.sample_until_converged(int(steps) // int(thin_by), show, profiles)


def _check_arguments(
    log_prob, profiles: LikelihoodProfiles | None, given: dict[str, Any], noise, level: str, concentration
) -> Increments:
    """The coordinates of the free frames; ValueError for arguments that conflict, are missing or out of range."""
    if log_prob is None:
        if given["model"] is None:
            raise invalid("model", expected="a VideoModel, or a `log_prob`", got=None)
        return check_request(given["model"], given["video"], noise, level, given["frames"], concentration, profiles)
    if not isinstance(log_prob, FrameTimeLogProb):
        raise invalid("log_prob", expected="the result of `frame_time_log_prob`", got=short_repr(log_prob))
    defaults = {"noise": (noise, DEFAULT_NOISE), "level": (level, "splats"), "concentration": (concentration, 1.0)}
    beside = [name for name, value in given.items() if value is not None]
    beside += [name for name, (value, usual) in defaults.items() if not (np.isscalar(value) and value == usual)]
    if beside:
        cure = "Give them to `frame_time_log_prob`, or leave `log_prob` out."
        expected = "nothing beside `log_prob`, which has its own"
        raise invalid(beside[0], expected=expected, got=", ".join(beside), cure=cure)
    if profiles is not None and (num := check_profiles(profiles, None)) != log_prob.curves.num_frames:
        expected = f"profiles of the {log_prob.curves.num_frames} frames of `log_prob`"
        raise invalid("profiles", expected=expected, got=f"{num} frames")
    return log_prob.increments


class _Run:
    """Several independent ensembles and their kept steps."""

    def __init__(self, log_prob: FrameTimeLogProb, settings: SamplerSettings):
        self.log_prob, self.thin_by, self.seed = log_prob, settings.thin_by, settings.seed
        self.walkers, self.free = settings.walkers, np.flatnonzero(log_prob.increments.free)
        moves = _default_moves(log_prob) if settings.moves is None else settings.moves
        self.exact = exact_posterior(log_prob.curves, log_prob.increments)
        self.laplace = laplace_approximation(log_prob.curves, log_prob.increments, self.exact.quantile(0.5))
        fingerprint = self._fingerprint(settings.ensembles, moves)
        shape = settings.ensembles, self.walkers, log_prob.num_free
        self.file = None if settings.backend is None else DrawsFile(settings.backend, fingerprint, shape)
        self.samplers = [self._make_sampler(n, moves) for n in range(settings.ensembles)]

    def _fingerprint(self, ensembles: int, moves: list[tuple[Any, float]]) -> str:
        """A hash of everything that the draws depend on."""
        curves, increments = self.log_prob.curves, self.log_prob.increments
        parts = [curves.nodes, curves.values, increments.held[~increments.free], increments.free]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        described = [(_describe(move), weight) for move, weight in moves]
        settings = increments.concentration, self.walkers, self.seed, ensembles, self.thin_by, described
        digest.update(repr(settings).encode())
        return digest.hexdigest()

    def _make_sampler(self, n: int, moves):
        import emcee

        backend = emcee.backends.Backend() if self.file is None else self.file.backend(n)
        sampler = emcee.EnsembleSampler(
            self.walkers, self.log_prob.num_free, self.log_prob, vectorize=True, moves=moves, backend=backend
        )
        if backend.iteration:
            sampler.start = backend.get_last_sample()
            return sampler
        seeds = seed_sequence(Stream.WALKERS, n, seed=self.seed)
        times = self.laplace.sample(self.walkers, np.random.default_rng(seeds))
        state = emcee.State(self.log_prob.increments.coordinates(times))
        state.random_state = np.random.RandomState(np.random.MT19937(seeds)).get_state()
        sampler.start = state
        return sampler

    def sample_until_converged(self, most: int, show, profiles: LikelihoodProfiles | None) -> FrameTimePosterior:
        done = min(sampler.iteration for sampler in self.samplers)
        goal = min(CHECK_EVERY, most)
        while True:
            if done >= min(CHECK_EVERY, most):
                found = self.result(profiles)
                if found.converged or done >= most:
                    if self.file is not None:
                        self.file.save()
                    return found
                required = 1.1 * (TIMES_TAU + BURN_IN) * found.tau.max() / self.thin_by
                goal = min(max(int(min(required, 2 * done)), done + max(CHECK_EVERY, done // 4)), most)
                del found  # free its draws before more are allocated
            self._advance_to(goal, show)
            done = goal

    def _advance_to(self, goal: int, show) -> None:
        """Sample until every ensemble has `goal` kept steps, and save them."""
        if self.file is not None:
            left = sum(goal - sampler.iteration for sampler in self.samplers)
            self.file.check_space(8 * left * self.walkers * (self.log_prob.num_free + 1))  # draws and log-densities
        for sampler in self.samplers:
            for _ in self._steps(sampler, goal - sampler.iteration):
                if show is not None:
                    done = sum(other.iteration for other in self.samplers)
                    show("steps", done * self.thin_by, len(self.samplers) * goal * self.thin_by)
        if self.file is not None:
            self.file.save()

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
                self.file.raise_system_error(error)
            raise invalid("moves", expected="moves that these walkers can make", got=str(error)) from error

    def times(self) -> Float64[np.ndarray, "ensembles steps walkers num_frames"]:
        """Times of all kept steps, converted in parts so that only one copy of all is made."""
        steps = min(sampler.iteration for sampler in self.samplers)
        increments = self.log_prob.increments
        times = np.empty((len(self.samplers), steps, self.walkers, increments.num_frames))
        for sampler, found in zip(self.samplers, times, strict=True):
            chain = sampler.get_chain()
            for first in range(0, steps, CHECK_EVERY):
                part = slice(first, min(first + CHECK_EVERY, steps))
                found[part] = increments.times(chain[part])
        return times

    def result(self, profiles: LikelihoodProfiles | None) -> FrameTimePosterior:
        times = self.times()
        steps = times.shape[1]
        tau = np.array([max(_autocorrelation_time(one[..., k]) for one in times) for k in self.free])
        burn = int(min(np.ceil(BURN_IN * tau.max()), steps // 2))
        times = times[:, burn:]
        kept = times.shape[1]
        found = FrameTimePosterior(
            self.log_prob,
            times,
            acceptance=np.array([np.mean(sampler.acceptance_fraction) for sampler in self.samplers]),
            tau=tau * self.thin_by,
            r_hat=np.array([_r_hat(times[..., k]) for k in self.free]),
            ess=kept * self.walkers * len(self.samplers) / tau,
            converged=False,
            message="",
            laplace=self.laplace,
            exact=self.exact,
            profiles=profiles,
        )
        missing = self._missing_for_convergence(found, kept / tau)
        done = f"onverged after {steps * self.thin_by:,} steps"
        cure = "Give more steps" + (", or use the exact posterior." if "exact" in str(missing) else ".")
        message = f"Not c{done}: {'; '.join(missing)}. {cure}" if missing else f"C{done}."
        identified = int(found.identified()[self.free].sum())
        if identified < len(self.free):
            message += f" {identified} of {len(self.free)} frame times are identified."
        return dataclasses.replace(found, converged=not missing, message=message)

    def _missing_for_convergence(
        self, found: FrameTimePosterior, lengths: Float64[np.ndarray, " num_free"]
    ) -> list[str]:
        """The criteria of convergence that are not met, in words; `lengths`: kept steps in autocorrelation times."""
        missing, free = [], self.free
        if not lengths.min() > TIMES_TAU:
            shortest = free[lengths.argmin()]
            missing.append(f"{lengths.min():.0f} autocorrelation times kept of frame {shortest}, not {TIMES_TAU:.0f}")
        if not found.r_hat.max() < R_HAT:
            missing.append(f"R-hat {found.r_hat.max():.3f} of frame {free[found.r_hat.argmax()]}, not below {R_HAT}")
        std = np.maximum(self.exact.std()[free], np.finfo(np.float64).tiny)
        apart = np.abs(found.mean() - self.exact.mean())[free] / std
        over = apart - (APART + ERRORS / np.sqrt(found.ess))
        if not over.max() <= 0:
            worst = over.argmax()
            text = f"emcee and the exact posterior disagree at frame {free[worst]}"
            missing.append(f"{text}, by {apart[worst]:.2g} standard deviations")
        return missing


def _autocorrelation_time(times: Float64[np.ndarray, "steps walkers"]) -> float:
    """Integrated autocorrelation time in kept steps, at least 1; all steps for a chain that never moves."""
    import emcee

    with np.errstate(invalid="ignore", divide="ignore"):
        found = float(emcee.autocorr.integrated_time(times[..., None], quiet=True, tol=0)[0])
    return max(found, 1.0) if np.isfinite(found) else float(len(times))


def _r_hat(times: Float64[np.ndarray, "ensembles steps walkers"]) -> float:
    """Split rank R-hat, with one chain per ensemble."""
    arviz = import_optional("arviz")
    return float(arviz.rhat(np.ascontiguousarray(times).reshape(len(times), -1), method="rank"))


def _default_moves(log_prob: FrameTimeLogProb) -> list[tuple[Any, float]]:
    from emcee.moves import DEMove, StretchMove

    from foldgauss.uncertainty.posterior.moves import BlockSweep

    sweep = BlockSweep(log_prob)
    # emcee's moves alone stay at the mode at which they start; sweeps change modes.
    return [(sweep, 0.5), (DEMove(), 0.3), (StretchMove(), 0.2)] if log_prob.num_free <= AT_ONCE else [(sweep, 1.0)]


def _describe(value, depth: int = 2) -> Any:
    """A move's class and settings (numbers, texts, arrays), recursively, for the fingerprint."""
    if value is None or isinstance(value, bool | str | int | float):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.shape, hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, list | tuple):
        return [_describe(each, depth) for each in value]
    kind = getattr(value, "__qualname__", type(value).__qualname__)
    if depth == 0 or isinstance(value, FrameTimeLogProb):  # the posterior has its own part of the fingerprint
        return kind
    inner = getattr(value, "__dict__", {})
    return kind, [(name, _describe(each, depth - 1)) for name, each in sorted(inner.items())]


def _labeled(show, what: str) -> Callable[[int, int], None] | None:
    return None if show is None else lambda done, total: show(what, done, total)


@contextlib.contextmanager
def _progress_function(progress) -> Iterator[Callable[[str, int, int], None] | None]:
    """A function that shows the progress, or None."""
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
