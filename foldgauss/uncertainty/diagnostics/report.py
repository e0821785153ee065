"""A posterior of frame times in words and as a table."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from foldgauss._runtime.checks import invalid
from foldgauss.uncertainty.diagnostics.irregularities import Irregularity, even_times, irregularities, judged
from foldgauss.uncertainty.posterior.result import FrameTimePosterior


def frame_table(
    posterior: FrameTimePosterior, fitted: Float[np.ndarray, " num_frames"] | None = None
) -> dict[str, np.ndarray]:
    """Columns with an entry for each frame: `frame`, `fitted` (NaN if not given), `mean`, `std`, `low_50`, `high_50`,
    `low_90`, `high_90`, `laplace_mode`, `laplace_std`, `exact_mean`, `exact_std`, `r_hat`, `tau`, `ess`, `identified`.

    **Units:** times of the model, [0, 1]; `tau` in steps. Frames whose times were held have a spread of 0, no `r_hat`,
    `tau` and `ess` (NaN), and count as identified. Raises ValueError for `fitted` of another length.
    """
    num_frames = posterior.times.shape[-1]
    fitted = np.full(num_frames, np.nan) if fitted is None else np.asarray(fitted, np.float64)
    if fitted.shape != (num_frames,):
        raise invalid("fitted", expected=f"{num_frames} times", got=f"shape {fitted.shape}")
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
        "laplace_mode": posterior.laplace.mode,
        "laplace_std": posterior.laplace.std,
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
    level: Literal["splats", "colors"] | None = None,
) -> str:
    """What was found, how far to trust it, and what it is conditioned on, in Markdown.

    `fitted`: the model's own times, which are compared. `flagged`: default `irregularities(posterior)`. `level`: what
    the posterior is given, all of the splats, or all but their colours; default: as its evidence says.

    **Example:** `print(summary(posterior, model.frame_times.times()))`.
    """
    flagged = irregularities(posterior) if flagged is None else flagged
    profiles = posterior.profiles
    level = level or ("splats" if profiles is None else profiles.level)
    parts = [
        posterior.message,
        *(f"**Note:** {note}" for note in (() if profiles is None else profiles.notes)),
        _sampling(posterior),
        "## How sure\n\n" + _sureness(posterior),
        "## Pace\n\n" + _pace(posterior, flagged),
        "## Against other times\n\n" + _against(posterior, fitted),
        "## What this is conditioned on\n\n" + _conditions(posterior, level),
    ]
    return "\n\n".join(parts) + "\n"


def _sampling(posterior: FrameTimePosterior) -> str:
    ensembles, steps, walkers, num_frames = posterior.times.shape
    free = posterior.free
    worst, longest, least = posterior.r_hat.argmax(), posterior.tau.argmax(), posterior.ess.argmin()
    rows = [
        ("frames, drawn", f"{num_frames}, {len(free)}"),
        ("ensembles, walkers each", f"{ensembles}, {walkers}"),
        ("states kept of each, after burn-in", f"{steps:,}"),
        ("acceptance", f"{posterior.acceptance.mean():.2f}"),
        ("greatest R-hat (below 1.01 wanted)", f"{posterior.r_hat[worst]:.4f}, frame {free[worst]}"),
        ("longest autocorrelation time", f"{posterior.tau[longest]:,.0f} steps, frame {free[longest]}"),
        ("least effective sample size", f"{posterior.ess[least]:,.0f}, frame {free[least]}"),
    ]
    return _table(("sampling", ""), rows)


def _sureness(posterior: FrameTimePosterior) -> str:
    """Spreads in frames, and whether the three ways to find them agree."""
    free, (_, unit) = posterior.free, even_times(posterior)
    std = posterior.std()[free]
    drawn, exact, laplace = std / unit, posterior.exact.std()[free] / unit, posterior.laplace.std[free] / unit
    widest, apart = drawn.argmax(), np.abs(posterior.mean() - posterior.exact.mean())[free] / exact / unit
    lines = [
        f"Standard deviation of a time: median {np.median(drawn):.3g} frames, greatest {drawn[widest]:.3g} "
        f"(frame {free[widest]}). One frame is 1 / {1 / unit:.4g} of the model's time.",
        f"emcee beside the exact passes: means differ by at most {apart.max():.2g} standard deviations; spreads are "
        f"{_factor(drawn, exact)} times as great. Laplace's approximation: {_factor(laplace, exact)} times.",
    ]
    unknown = np.flatnonzero(~posterior.identified())
    if len(unknown):
        lines.append(
            f"**Not identified: {_listed(unknown)}.** There the pictures say little more than the order of the frames, "
            "and intervals are the prior's."
        )
    return "\n\n".join(lines)


def _pace(posterior: FrameTimePosterior, flagged: Sequence[Irregularity]) -> str:
    asked = judged(posterior)
    others = (
        ""
        if asked.all()
        else (f" {int((~asked).sum())} others were not judged: cuts, frames that are held or do not tell their time.")
    )
    caution = (
        "A gap, or a frame shown twice, in the very frames that the model was fitted to may be taken up by its clock "
        "and its folds; the model of a clip that has the frames left out sees it."
    )
    if not flagged:
        found = "none looks like that of a duplicated frame, or of frames left out"
        return f"Of {int(asked.sum())} intervals {found}.{others} {caution}"
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
            "\n\nA long step beside a duplicated frame: that frame stands in the place of one that was left out; or "
            "the splats themselves stand still there, since they were fitted to it, and it may lie anywhere there."
        )
    return f"{text}\n\n{caution}{others}"


def _against(posterior: FrameTimePosterior, fitted) -> str:
    """Log-likelihoods of whole sets of times."""
    log_prob = posterior.log_prob
    times = {"posterior mean": posterior.mean(), "evenly spaced": np.linspace(0, 1, posterior.times.shape[-1])}
    if fitted is not None:
        times["as fitted"] = np.asarray(fitted, np.float64)
    rows = [(name, f"{float(log_prob.log_likelihood(each)):,.1f}") for name, each in times.items()]
    some = posterior.draws[:: max(len(posterior.draws) // 1000, 1)]
    rows.append(("draws, mean", f"{float(log_prob.log_likelihood(some).mean()):,.1f}"))
    return _table(("times", "log-likelihood (nats; 0: each frame about its best)"), rows)


def _conditions(posterior: FrameTimePosterior, level: str) -> str:
    increments = posterior.log_prob.increments
    held = "durations, colours" if level == "splats" else "durations; their colours are integrated out"
    lines = [
        f"- The splats, held as they were fitted: places, folds, {held}. A warp of time that the folds have taken up "
        "does not show: intervals are those of times given the folds."
    ]
    if posterior.profiles is not None:
        lines.append(f"- The noise: {posterior.profiles.noise.describe()}.")
    lines.append(f"- The prior: Dirichlet on the increments, of concentration {increments.concentration:g}.")
    held = np.flatnonzero(~increments.free)[1:-1]
    text = "- The first frame at 0 and the last at 1"
    lines.append(f"{text}, and the times of {_listed(held)}, held." if len(held) else f"{text}.")
    return "\n".join(lines)


def _factor(one: np.ndarray, other: np.ndarray) -> str:
    ratio = one / other
    return f"{ratio.min():.2f} to {ratio.max():.2f}"


def _listed(frames: np.ndarray) -> str:
    """Frames as runs: 3 to 7, 9."""
    runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    each = [f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    shown = ", ".join(each[:12]) + (", .." if len(each) > 12 else "")
    return f"frame {shown}" if len(frames) == 1 else f"frames {shown}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
