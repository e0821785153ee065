"""Sampling of the posterior of frame times by emcee: ensembles, convergence, resumption from a file."""

import dataclasses
import errno
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foldgauss._numerics.random_streams import Stream, seed_sequence
from foldgauss._runtime.checks import invalid, is_integer, require, short_repr
from foldgauss._runtime.optional_imports import import_optional
from foldgauss.uncertainty.likelihood.likelihood_profiles import LikelihoodProfiles
from foldgauss.uncertainty.posterior.exact import exact_posterior
from foldgauss.uncertainty.posterior.log_prob import FrameTimeLogProb
from foldgauss.uncertainty.posterior.result import FrameTimePosterior

#: Convergence: at least so many autocorrelation times are kept,
TIMES_TAU = 50.0
#: split rank R-hat is below this,
R_HAT = 1.01
#: and means differ from the exact ones by at most so many standard deviations
APART = 0.1
#: plus so many standard errors.
ERRORS = 5.0
#: Burn-in, in autocorrelation times.
BURN_IN = 10.0
#: Kept steps between two checks of convergence.
CHECK_EVERY = 50
#: Steps per kept step.
THIN = 10
#: Walkers of an ensemble.
WALKERS = 32
#: Disk space that an HDF5 file needs beside its draws, in bytes.
SPARE_BYTES = 4 << 20


def frame_time_posterior(
    profiles: LikelihoodProfiles,
    *,
    concentration: float = 1.0,
    steps: int = 20_000,
    ensembles: int = 4,
    seed: int = 0,
    backend: str | os.PathLike | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> FrameTimePosterior:
    """Sample the times of all frames but the first and the last from their posterior given the splats.

    Independent emcee ensembles, started from exact draws, run until more than 50 autocorrelation times of every frame
    are kept, split rank R-hat is below 1.01 for all and the means agree with the exact ones, or for `steps` steps, of
    which every tenth is kept. A step is a `FrameSweep`.

    `concentration`: see `FrameTimeLogProb`. `backend`: an HDF5 file to which emcee's `HDFBackend` writes
    the draws; called again with the same arguments, sampling resumes. `on_progress` is called with the numbers of steps
    done and planned so far.

    **Memory:** 16 bytes per kept time (ensembles x (steps / 10) x walkers x frames).

    Raises ValueError for settings out of range, a backend that cannot be written or is of another run, a NaN
    log-probability, and frames out of the model's order; ImportError without emcee.

    Example: `frame_time_posterior(likelihood_profiles(model, frames)).interval(0.9)`.
    """
    import_optional("emcee", "uncertainty")
    import_optional("arviz", "uncertainty")
    check_settings(steps, ensembles, seed)
    require(
        isinstance(profiles, LikelihoodProfiles),
        "profiles",
        expected="the result of `likelihood_profiles`",
        got=short_repr(profiles),
    )
    log_prob = FrameTimeLogProb(profiles.curves, concentration)
    run = _Run(log_prob, profiles, ensembles, seed, None if backend is None else Path(backend))
    return run.sample_until_converged(int(steps) // THIN, on_progress)


def check_settings(steps: int, ensembles: int, seed: int) -> None:
    """ValueError for settings of `frame_time_posterior` that are out of range."""
    require(
        is_integer(ensembles, 2),
        "ensembles",
        expected="at least 2 (a whole number), better 4: R-hat compares them",
        got=short_repr(ensembles),
    )
    require(is_integer(steps, THIN), "steps", expected=f"a whole number >= {THIN}", got=short_repr(steps))
    require(is_integer(seed, 0), "seed", expected="a whole number >= 0", got=short_repr(seed))


class _Run:
    """Several independent ensembles and their kept steps."""

    def __init__(
        self, log_prob: FrameTimeLogProb, profiles: LikelihoodProfiles, ensembles: int, seed: int, backend: Path | None
    ):
        self.log_prob, self.profiles, self.seed, self.backend = log_prob, profiles, seed, backend
        self.exact = exact_posterior(log_prob.curves, log_prob.concentration)
        if backend is not None:
            _open_draws(backend, self._fingerprint(ensembles))
        self.samplers = [self._make_sampler(n) for n in range(ensembles)]

    def _fingerprint(self, ensembles: int) -> str:
        """A hash of everything that the draws depend on."""
        curves = self.log_prob.curves
        digest = hashlib.sha256(curves.nodes.tobytes() + curves.values.tobytes())
        digest.update(repr((self.log_prob.concentration, int(self.seed), int(ensembles))).encode())
        return digest.hexdigest()

    def _make_sampler(self, n: int):
        import emcee

        from foldgauss.uncertainty.posterior.moves import FrameSweep

        kept = emcee.backends.Backend()
        if self.backend is not None:
            kept = emcee.backends.HDFBackend(str(self.backend), name=f"ensemble_{n}")
        sampler = emcee.EnsembleSampler(
            WALKERS,
            self.log_prob.num_free,
            self.log_prob,
            vectorize=True,
            moves=FrameSweep(self.log_prob),
            backend=kept,
        )
        if kept.iteration:
            sampler.start = kept.get_last_sample()
            return sampler
        seeds = seed_sequence(Stream.WALKERS, n, seed=self.seed)
        times = self.exact.sample(WALKERS, int(seeds.generate_state(1)[0]))
        sampler.start = emcee.State(times[:, 1:-1])
        sampler.start.random_state = np.random.RandomState(np.random.MT19937(seeds)).get_state()
        return sampler

    def sample_until_converged(self, most: int, on_progress: Callable[[int, int], None] | None) -> FrameTimePosterior:
        done = min(sampler.iteration for sampler in self.samplers)
        goal = min(CHECK_EVERY, most)
        while True:
            if done >= goal:
                found = self.result()
                if found.converged or done >= most:
                    return found
                required = 1.1 * (TIMES_TAU + BURN_IN) * found.tau.max() / THIN
                goal = min(max(int(min(required, 2 * done)), done + max(CHECK_EVERY, done // 4)), most)
            for _ in self._advance_to(goal):
                if on_progress is not None:
                    on_progress(sum(one.iteration for one in self.samplers) * THIN, len(self.samplers) * goal * THIN)
            done = goal

    def _advance_to(self, goal: int) -> Iterator[None]:
        """Sample until every ensemble has `goal` kept steps."""
        if self.backend is not None:
            left = sum(goal - sampler.iteration for sampler in self.samplers)
            _check_space(self.backend, 8 * left * WALKERS * (self.log_prob.num_free + 1))
        for sampler in self.samplers:
            for state in sampler.sample(
                sampler.start, iterations=goal - sampler.iteration, thin_by=THIN, skip_initial_state_check=True
            ):
                sampler.start = state
                yield

    def result(self) -> FrameTimePosterior:
        steps = min(sampler.iteration for sampler in self.samplers)
        times = np.stack([self.log_prob.times(one.get_chain()[:steps]) for one in self.samplers])
        free = range(1, times.shape[-1] - 1)
        tau = np.array([max(_autocorrelation_time(one[..., k]) for one in times) for k in free])
        times = times[:, int(min(np.ceil(BURN_IN * tau.max()), steps // 2)) :]
        kept = times.shape[1]
        found = FrameTimePosterior(
            self.log_prob,
            self.profiles,
            self.exact,
            times,
            acceptance=np.array([np.mean(sampler.acceptance_fraction) for sampler in self.samplers]),
            tau=tau * THIN,
            r_hat=np.array([_r_hat(times[..., k]) for k in free]),
            ess=kept * WALKERS * len(self.samplers) / tau,
        )
        missing = _missing_for_convergence(found, kept / tau)
        message = f"Converged after {steps * THIN:,} steps."
        if missing:
            cure = "Give more steps" + (", or use the exact posterior." if "exact" in str(missing) else ".")
            message = f"Not converged after {steps * THIN:,} steps: {'; '.join(missing)}. {cure}"
        identified = int(found.identified()[1:-1].sum())
        if identified < len(free):
            message += f" {identified} of {len(free)} frame times are identified."
        return dataclasses.replace(found, converged=not missing, message=message)


def _missing_for_convergence(found: FrameTimePosterior, lengths: Float64[np.ndarray, " num_free"]) -> list[str]:
    """The criteria of convergence that are not met, in words; `lengths`: kept steps in autocorrelation times."""
    missing, free = [], found.free
    if not lengths.min() > TIMES_TAU:
        shortest = free[lengths.argmin()]
        missing.append(f"{lengths.min():.0f} autocorrelation times kept of frame {shortest}, not {TIMES_TAU:.0f}")
    if not found.r_hat.max() < R_HAT:
        missing.append(f"R-hat {found.r_hat.max():.3f} of frame {free[found.r_hat.argmax()]}, not below {R_HAT}")
    std = np.maximum(found.exact.std()[free], np.finfo(np.float64).tiny)
    apart = np.abs(found.mean() - found.exact.mean())[free] / std
    over = apart - (APART + ERRORS / np.sqrt(found.ess))
    if not over.max() <= 0:
        worst = over.argmax()
        text = f"emcee and the exact posterior disagree at frame {free[worst]}"
        missing.append(f"{text}, by {apart[worst]:.2g} standard deviations")
    return missing


def _open_draws(path: Path, fingerprint: str) -> None:
    """Create a file of draws, or check that an existing one is of the run with this fingerprint."""
    existed = path.exists()
    try:
        _check_space(path, 0)
        with import_optional("h5py", "uncertainty").File(path, "a") as file:
            found = file.attrs.setdefault("fingerprint", "" if existed else fingerprint)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EAGAIN, errno.EACCES):  # a full disk; a file that is open elsewhere
            raise
        got, cure = f"{path}, damaged or not to be written", "Remove it, or choose another, in a folder that exists."
        raise invalid("backend", expected="a file of draws, or none yet", got=got, cure=cure) from error
    require(
        found == fingerprint,
        "backend",
        expected="the file of this very run",
        got=f"{path}, of another run",
        cure="Choose another file, or give the same model, video and settings.",
    )


def _check_space(path: Path, num_bytes: int) -> None:
    """Raise OSError if the disk lacks space for `num_bytes` more: HDF5 may crash on a full disk."""
    if shutil.disk_usage(path.parent).free < num_bytes + SPARE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _autocorrelation_time(times: Float64[np.ndarray, "steps walkers"]) -> float:
    """Integrated autocorrelation time in kept steps, at least 1; all steps for a chain that never moves."""
    import emcee

    with np.errstate(invalid="ignore", divide="ignore"):
        found = float(emcee.autocorr.integrated_time(times[..., None], quiet=True, tol=0)[0])
    return max(found, 1.0) if np.isfinite(found) else float(len(times))


def _r_hat(times: Float64[np.ndarray, "ensembles steps walkers"]) -> float:
    """Split rank R-hat, with one chain per ensemble."""
    arviz = import_optional("arviz", "uncertainty")
    return float(arviz.rhat(np.ascontiguousarray(times).reshape(len(times), -1), method="rank"))
