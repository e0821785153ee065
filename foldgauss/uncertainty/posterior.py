"""Frame times drawn from their posterior by emcee."""

import contextlib
import dataclasses
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

from foldgauss._checks import invalid
from foldgauss.uncertainty.drawing import Evidence, evidence
from foldgauss.uncertainty.exact import ExactTimes, exact_times
from foldgauss.uncertainty.laplace import LaplaceTimes, laplace_times
from foldgauss.uncertainty.log_prob import FrameTimeLogProb, at_level, frame_time_log_prob
from foldgauss.uncertainty.noise import FrameNoise
from foldgauss.video.model import VideoModel

if TYPE_CHECKING:
    import arviz

#: Sampling has converged with so many autocorrelation times kept, and split rank R-hat below this.
TIMES_TAU, R_HAT = 50.0, 1.01
#: Thrown away at the start: so many autocorrelation times.
BURN_IN = 10.0
#: Steps per one that is kept; kept steps between two looks at convergence.
THIN, LOOK = 10, 50
#: Up to so many free frames emcee's own moves take all at once; beyond, blocks of frames do.
AT_ONCE = 12


@dataclasses.dataclass(frozen=True)
class FrameTimePosterior:
    r"""Draws of frame times, and how far to trust them.

    **Shapes:** `times` (ensembles, steps, walkers, num_frames) after burn-in; `acceptance` (ensembles,), the mean share
    of proposals accepted; `tau`, `r_hat`, `ess` (num_free,) in the order of `free`: integrated autocorrelation time in
    steps of the sampler, split rank R-hat over the ensembles, and effective sample size.

    `converged`: more than 50 tau of every frame, and every R-hat < 1.01. `message` says so, or what is missing.
    `laplace`, `exact`: the same posterior by Laplace's approximation and by forward and backward passes.

    **Source:** emcee, Foreman-Mackey et al. 2013; R-hat, Vehtari et al. 2021. The walkers of one ensemble depend on
    each other, so each ensemble is one chain; ESS is steps times walkers over tau.
    """

    log_prob: FrameTimeLogProb
    times: Float64[np.ndarray, "ensembles steps walkers num_frames"]
    acceptance: Float64[np.ndarray, "ensembles"]
    tau: Float64[np.ndarray, "num_free"]
    r_hat: Float64[np.ndarray, "num_free"]
    ess: Float64[np.ndarray, "num_free"]
    converged: bool
    message: str
    laplace: LaplaceTimes
    exact: ExactTimes
    seen: Evidence | None = None

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

    def mean(self) -> Float64[np.ndarray, "num_frames"]:
        return self.draws.mean(0)

    def std(self) -> Float64[np.ndarray, "num_frames"]:
        return self.draws.std(0)

    def interval(self, level: float = 0.9) -> Float64[np.ndarray, "2 num_frames"]:
        """Ends of the central intervals that hold `level` of the draws."""
        if not 0 < level < 1:
            raise invalid("level", expected="a number in (0, 1)", got=level)
        return np.quantile(self.draws, [(1 - level) / 2, (1 + level) / 2], axis=0)

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
    noise: str | FrameNoise = "score",
    level: str = "splats",
    concentration: float = 1.0,
    ensembles: int = 4,
    thin_by: int = THIN,
    backend: str | os.PathLike | None = None,
    seen: Evidence | None = None,
    log_prob: FrameTimeLogProb | None = None,
) -> FrameTimePosterior:
    """Draw the times of `frames` (default: of all but the first and the last) from their posterior, given the splats.

    Independent emcee ensembles of `walkers` each, started from Laplace's approximation, run until more than 50
    autocorrelation times of every frame are kept and split rank R-hat is below 1.01 for all, or for `steps` steps, of
    which every `thin_by`-th is kept. A few frames move by emcee's differential evolution and stretch moves, many by
    `BlockSweep`; or by `moves`, as `emcee.EnsembleSampler` takes them.

    `noise`, `level`, `concentration`, `video`: see `frame_time_log_prob`, whose result may be handed in as `log_prob`.
    `progress`: a bar, or a function of (what, done, of how many). `backend`: an HDF5 file to which all is written as
    it goes; called again with the same arguments, sampling goes on where it stopped, to the same bits.

    Raises ValueError for fewer walkers than twice the frames that move at once, settings out of range, a backend of
    another run, a NaN log-probability, and whatever `frame_time_log_prob` refuses; ImportError without emcee.

    Example: `frame_time_posterior(model, frames).interval(0.9)`.
    """
    needed("emcee")
    _check_steps(steps, thin_by)
    with _shown(progress) as show:
        if log_prob is None:
            if model is None:
                raise invalid("model", expected="a VideoModel, or a `log_prob`", got=None)
            look = None if show is None else (lambda done, total: show("pictures", done, total))
            if seen is None:
                seen = evidence(model, video, noise=noise, on_picture=look)
            look = None if show is None else (lambda done, total: show("frames", done, total))
            seen = at_level(level, model, video, seen, frames, look)
            log_prob = frame_time_log_prob(model, frames=frames, concentration=concentration, seen=seen)
        run = _Run(log_prob, walkers, moves, seed, ensembles, thin_by, backend)
        return run.until_converged(steps // thin_by, show, seen)


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
    from foldgauss.uncertainty.moves import BLOCK

    at_once = num_free if together or num_free <= AT_ONCE else BLOCK
    found = max(32, 4 * at_once + at_once % 2) if walkers is None else walkers
    if found < 2 * at_once or found < 4 or found % 2:
        expected = f"an even number, at least {max(2 * at_once, 4)}: twice the frames that move at once"
        raise invalid("walkers", expected=expected, got=walkers, cure="Leave it out, or choose fewer frames.")
    if ensembles < 2:
        raise invalid("ensembles", expected="at least 2, better 4: R-hat compares them", got=ensembles)
    if steps is not None:
        _check_steps(steps, thin_by)
    return found


def _check_steps(steps: int, thin_by: int) -> None:
    if thin_by < 1:
        raise invalid("thin_by", expected="a whole number >= 1", got=thin_by)
    if steps < thin_by:
        raise invalid("steps", expected=f"at least thin_by = {thin_by}", got=steps)


class _Run:
    """Some independent ensembles, and what they have kept."""

    def __init__(self, log_prob: FrameTimeLogProb, walkers, moves, seed: int, ensembles: int, thin_by: int, backend):
        from foldgauss.uncertainty.moves import BlockSweep

        self.log_prob, self.thin_by, self.seed = log_prob, thin_by, seed
        num = log_prob.num_free
        self.walkers = check_settings(num, walkers, ensembles=ensembles, together=moves is not None)
        if "DESnookerMove" in ([] if moves is None else _kinds(moves)) and _version("emcee") < (3, 1, 7):
            cure = "Its proposals are scaled wrongly (emcee pull request 531): take DEMove, or a later emcee."
            raise invalid(
                "moves", expected="moves that draw what they should", got="DESnookerMove of emcee 3.1", cure=cure
            )
        if moves is None:
            moves = _few_moves() if num <= AT_ONCE else BlockSweep(log_prob)
        self.exact = exact_times(log_prob.profiles, log_prob.increments)
        self.laplace = laplace_times(log_prob.profiles, log_prob.increments, self.exact.quantile(0.5))
        self.file = None if backend is None else _Kept(backend, self._fingerprint(ensembles, moves))
        self.samplers = [self._sampler(n, moves) for n in range(ensembles)]

    def _fingerprint(self, ensembles: int, moves) -> str:
        """Of everything that the draws depend on."""
        found, increments = self.log_prob.profiles, self.log_prob.increments
        parts = [found.nodes, found.values, increments.held[~increments.free], increments.free]
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        settings = increments.concentration, self.walkers, self.seed, ensembles, self.thin_by, _kinds(moves)
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

    def until_converged(self, most: int, show, seen: Evidence | None) -> FrameTimePosterior:
        done = min(sampler.iteration for sampler in self.samplers)
        goal = min(LOOK, most)
        while True:
            if done >= min(LOOK, most):
                found = self.result(seen)
                if found.converged or done >= most:
                    if self.file is not None:
                        self.file.close()
                    return found
                needed = 1.1 * (TIMES_TAU + BURN_IN) * found.tau.max() / self.thin_by
                goal = min(max(int(min(needed, 2 * done)), done + LOOK), most)
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
        except RuntimeError as error:
            raise invalid("moves", expected="moves that these walkers can make", got=str(error)) from error

    def result(self, seen: Evidence | None) -> FrameTimePosterior:
        import emcee

        chains = np.stack([sampler.get_chain() for sampler in self.samplers])
        times = self.log_prob.increments.times(chains)
        free = np.flatnonzero(self.log_prob.increments.free)
        steps = times.shape[1]
        drawn = times[..., free]
        tau = np.max([emcee.autocorr.integrated_time(each, quiet=True, tol=0) for each in drawn], axis=0)
        tau = np.where(np.isfinite(tau), np.maximum(tau, 1.0), steps)
        burn = int(min(np.ceil(BURN_IN * tau.max()), steps // 2))
        drawn = drawn[:, burn:]
        r_hat = _r_hat(drawn)
        kept = drawn.shape[1]
        ess = kept * self.walkers * len(self.samplers) / tau
        lengths = kept / tau
        wrong = []
        if lengths.min() <= TIMES_TAU:
            wrong.append(
                f"{lengths.min():.0f} autocorrelation times kept of frame {free[lengths.argmin()]}, not {TIMES_TAU:.0f}"
            )
        if not r_hat.max() < R_HAT:
            wrong.append(f"R-hat {r_hat.max():.3f} of frame {free[r_hat.argmax()]}, not below {R_HAT}")
        message = (
            f"Converged after {steps * self.thin_by:,} steps."
            if not wrong
            else (f"Not converged after {steps * self.thin_by:,} steps: {'; '.join(wrong)}. Give more steps.")
        )
        acceptance = np.array([np.mean(sampler.acceptance_fraction) for sampler in self.samplers])
        return FrameTimePosterior(
            self.log_prob,
            times[:, burn:],
            acceptance,
            tau * self.thin_by,
            r_hat,
            ess,
            not wrong,
            message,
            self.laplace,
            self.exact,
            seen,
        )


def _r_hat(drawn: Float64[np.ndarray, "ensembles steps walkers frames"]) -> Float64[np.ndarray, "frames"]:
    """Split rank R-hat, an ensemble a chain."""
    arviz = needed("arviz")
    ensembles, steps, walkers, frames = drawn.shape
    chains = drawn.reshape(ensembles, steps * walkers, frames)
    return np.array([float(arviz.rhat(np.ascontiguousarray(chains[..., n]), method="rank")) for n in range(frames)])


def _few_moves() -> list[tuple[Any, float]]:
    from emcee.moves import DEMove, StretchMove

    return [(DEMove(), 0.7), (StretchMove(), 0.3)]


def _kinds(moves) -> list[str]:
    """Names of moves, as `emcee.EnsembleSampler` takes them."""
    each = moves if isinstance(moves, list | tuple) else [moves]
    return [type(move[0] if isinstance(move, tuple) else move).__name__ for move in each]


class _Kept:
    """An HDF5 file of all ensembles that is whole at any moment: sampling writes beside it, and it is replaced."""

    def __init__(self, path: str | os.PathLike, fingerprint: str):
        h5py = needed("h5py")
        self.path = Path(path)
        self.live = self.path.with_name(f".{self.path.name}.running")
        if self.path.exists():
            try:
                with h5py.File(self.path) as file:
                    kept = file.attrs.get("fingerprint", "")
            except OSError as error:
                raise invalid(
                    "backend", expected="an HDF5 file, or none yet", got=str(self.path), cure="Choose another."
                ) from error
            if kept != fingerprint:
                cure = "Choose another file, or give the same model, video and settings."
                raise invalid(
                    "backend", expected="the file of this very run", got=f"{self.path}, of another", cure=cure
                )
            shutil.copyfile(self.path, self.live)
        else:
            with h5py.File(self.live, "w") as file:
                file.attrs["fingerprint"] = fingerprint

    def of(self, n: int):
        import emcee

        return emcee.backends.HDFBackend(str(self.live), name=f"ensemble_{n}")

    def keep(self) -> None:
        """What is written so far replaces the file."""
        copy = self.path.with_name(f".{self.path.name}.new")
        shutil.copyfile(self.live, copy)
        os.replace(copy, self.path)

    def close(self) -> None:
        self.keep()
        self.live.unlink()


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


@contextlib.contextmanager
def _shown(progress) -> Iterator[Callable[[str, int, int], None] | None]:
    """A function that shows how far things are, or None."""
    if not progress or callable(progress):
        yield progress or None
        return
    from rich.progress import Progress

    with Progress(transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what.capitalize(), total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield show
