"""Summary of the posterior of frame times as Markdown and as a table."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import require
from foldgauss.uncertainty.diagnostics.irregularities import Irregularity, even_times, irregularities, is_assessable
from foldgauss.uncertainty.posterior.result import FrameTimePosterior


def frame_table(
    posterior: FrameTimePosterior, fitted: Float[np.ndarray, " num_frames"] | None = None
) -> dict[str, np.ndarray]:
    """Columns with one entry per frame: `frame`, `fitted` (NaN if not given), `mean`, `std`, `low_50`, `high_50`,
    `low_90`, `high_90`, `exact_mean`, `exact_std`, `r_hat`, `tau`, `ess`, `identified`.

    **Units:** times of the model, [0, 1]; `tau` in steps. The first and the last frame have a spread of 0, NaN for
    `r_hat`, `tau` and `ess`, and count as identified. Raises ValueError for `fitted` of another length.
    """
    num_frames = posterior.times.shape[-1]
    fitted = np.full(num_frames, np.nan) if fitted is None else np.asarray(fitted, np.float64)
    require(fitted.shape == (num_frames,), "fitted", expected=f"{num_frames} times", got=f"shape {fitted.shape}")
    inner, outer = posterior.interval(0.5), posterior.interval(0.9)
    columns = {
        "frame": np.arange(num_frames),
        "fitted": fitted,
        "mean": posterior.mean(),
        "std": posterior.std(),
        "low_50": inner[0],
        "high_50": inner[1],
        "low_90": outer[0],
        "high_90": outer[1],
        "exact_mean": posterior.exact.mean(),
        "exact_std": posterior.exact.std(),
    }
    for name in ("r_hat", "tau", "ess"):
        columns[name] = np.full(num_frames, np.nan)
        columns[name][posterior.free] = getattr(posterior, name)
    return columns | {"identified": posterior.identified()}


def summary(
    posterior: FrameTimePosterior,
    fitted: Float[np.ndarray, " num_frames"] | None = None,
    *,
    flagged: Sequence[Irregularity] | None = None,
) -> str:
    """Results, convergence, and what the posterior is conditioned on, in Markdown.

    `fitted`: the model's own times, for comparison. `flagged`: default `irregularities(posterior)`.

    **Example:** `print(summary(posterior, model.frame_times.times()))`.
    """
    flagged = irregularities(posterior) if flagged is None else flagged
    parts = [
        posterior.message,
        *(f"**Note:** {note}" for note in posterior.profiles.notes),
        _sampling(posterior),
        "## Precision\n\n" + _precision(posterior),
        "## Playback speed\n\n" + _playback_speed(posterior, flagged),
        "## Comparison with other times\n\n" + _comparison(posterior, fitted),
        "## Conditioned on\n\n" + _conditions(posterior),
    ]
    return "\n\n".join(parts) + "\n"


def _sampling(posterior: FrameTimePosterior) -> str:
    ensembles, steps, walkers, num_frames = posterior.times.shape
    free = posterior.free
    worst, longest, least = posterior.r_hat.argmax(), posterior.tau.argmax(), posterior.ess.argmin()
    rows = [
        ("frames, sampled", f"{num_frames}, {len(free)}"),
        ("ensembles, walkers each", f"{ensembles}, {walkers}"),
        ("states kept of each, after burn-in", f"{steps:,}"),
        ("acceptance", f"{posterior.acceptance.mean():.2f}"),
        ("largest R-hat (required: below 1.01)", f"{posterior.r_hat[worst]:.4f}, frame {free[worst]}"),
        ("longest autocorrelation time", f"{posterior.tau[longest]:,.0f} steps, frame {free[longest]}"),
        ("smallest effective sample size", f"{posterior.ess[least]:,.0f}, frame {free[least]}"),
    ]
    return _table(("sampling", ""), rows)


def _precision(posterior: FrameTimePosterior) -> str:
    """Standard deviations in frames, and whether emcee and the exact posterior agree."""
    free, (_, unit) = posterior.free, even_times(posterior)
    std = posterior.std()[free]
    sampled, exact = std / unit, posterior.exact.std()[free] / unit
    widest, apart = sampled.argmax(), np.abs(posterior.mean() - posterior.exact.mean())[free] / exact / unit
    lines = [
        f"Standard deviation of a time: median {np.median(sampled):.3g} frames, largest {sampled[widest]:.3g} "
        f"(frame {free[widest]}). One frame is 1 / {1 / unit:.4g} of the model's time.",
        f"emcee against the exact posterior: means differ by at most {apart.max():.2g} standard deviations, the ratio "
        f"of standard deviations is {(sampled / exact).min():.2f} to {(sampled / exact).max():.2f}.",
    ]
    unknown = np.flatnonzero(~posterior.identified())
    if len(unknown):
        lines.append(
            f"**Not identified: {_listed(unknown)}.** The frames carry little information beyond their order, "
            "and the intervals are those of the prior."
        )
    return "\n\n".join(lines)


def _playback_speed(posterior: FrameTimePosterior, flagged: Sequence[Irregularity]) -> str:
    assessable = is_assessable(posterior)
    others = (
        ""
        if assessable.all()
        else (f" {int((~assessable).sum())} others were not assessed: cuts, and frames that are not identified.")
    )
    caution = (
        "A gap or a duplicate among the frames that the model was fitted to may be absorbed by its frame times and "
        "folds; a model fitted to a clip that contains the missing frames reveals it."
    )
    if not flagged:
        return f"None of {int(assessable.sum())} intervals shows a duplicated or dropped frame.{others} {caution}"
    rows = [
        (
            "{}, {}".format(*one.frames),
            one.kind,
            f"{one.probability:.3f}",
            f"{one.size:.3f}",
            f"{one.low:.3f} to {one.high:.3f}",
        )
        for one in flagged
    ]
    text = _table(("frames", "kind", "probability", "increment / local median", "90%"), rows)
    twice = {one.frames for one in flagged if one.kind == "duplicated"}
    beside = {(first + step, last + step) for first, last in twice for step in (-1, 1)}
    if any(one.kind == "dropped" and one.frames in beside for one in flagged):
        text += (
            "\n\nA long step beside a duplicated frame: the duplicate replaces a dropped frame; or the splats are "
            "static there, since they were fitted to the duplicate, and its time is arbitrary within that interval."
        )
    return f"{text}\n\n{caution}{others}"


def _comparison(posterior: FrameTimePosterior, fitted) -> str:
    """Log-likelihoods of alternative frame times."""
    log_prob = posterior.log_prob
    times = {"posterior mean": posterior.mean(), "evenly spaced": np.linspace(0, 1, posterior.times.shape[-1])}
    if fitted is not None:
        times["as fitted"] = np.asarray(fitted, np.float64)
    rows = [(name, f"{float(log_prob.log_likelihood(each)):,.1f}") for name, each in times.items()]
    some = posterior.draws[:: max(len(posterior.draws) // 1000, 1)]
    rows.append(("draws, mean", f"{float(log_prob.log_likelihood(some).mean()):,.1f}"))
    return _table(("times", "log-likelihood (nats; 0: each frame near its mode)"), rows)


def _conditions(posterior: FrameTimePosterior) -> str:
    lines = [
        "- The splats, held as fitted: positions, folds, durations, colors. Folds and the maps of an unsteady camera "
        "may have absorbed a warp of time. Intervals do not include it.",
        f"- The noise: {posterior.profiles.noise.describe()}.",
        f"- The prior: Dirichlet on the increments, of concentration {posterior.log_prob.concentration:g}.",
        "- The first frame at 0 and the last at 1.",
    ]
    return "\n".join(lines)


def _listed(frames: np.ndarray) -> str:
    """Frames as runs: 3 to 7, 9."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    each = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    shown = ", ".join(each[:12]) + (", .." if len(each) > 12 else "")
    return f"frame {shown}" if len(frames) == 1 else f"frames {shown}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
