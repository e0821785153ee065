"""Search of settings of a fit, by the quality that clips reach in equal CPU time.

    python -m benchmarks.tune --cpu-seconds S [--clips FOLDER] [--samples bunny|bikes|carphone ...] [--trials N]
                              [--study FILE] [--jobs J] [--only NAME ...] [--gaussians N] [--size HxW] [--frames N]
                              [--seed S] [--json FILE]

Optuna's TPE sampler proposes settings; each trial fits all clips with them, on one thread, for S seconds of the CPU
time of its process, so that other work on the machine takes nothing from it. The objective is the mean over the clips
of the mean PSNR over the frames of 8-bit images. The first trial has the default settings, and gains are relative to
it. With --jobs the clips of a trial are fitted in J processes; caches and memory bandwidth are shared, so compare
figures of equal J only.

Searched are factors on each default of `LearningRates` (0.25 to 4, on a logarithmic scale), and `final_rate`,
`ssim_fraction`, `l2_fraction`, `cooldown_fraction`, `error_fraction`, `relocated_fraction` and `degree`; `SPACE` has
the ranges. `--only` names those that are searched, the others keep their defaults.

With --study trials are kept in FILE, a SQLite database: the same command continues to --trials in all. A trial that was
interrupted is marked as failed and repeated. A trial one of whose fits diverges is marked as pruned. Proposals depend
on the seed and the finished trials only, so an interruption does not change them; the PSNR of equal settings varies a
little, since CPU time does.

The clips are the subfolders of --clips, a folder of images each, and the sample clips. Best settings are those of the
best trial: the more trials, the more of their gain is chance, so measure them again on other clips.
"""

import argparse
import dataclasses
import functools
import json
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from benchmarks import _common
from benchmarks._clips import SAMPLE_SIZES, ClipSource, folder_sources, sample_sources
from benchmarks._common import console
from benchmarks._runs import Run, scores
from benchmarks.presets import minutes as positive
from foldgauss._runtime.file_lock import LockHeld, hold_lock
from foldgauss._runtime.threads import set_num_threads
from foldgauss.io._atomic import check_writable
from foldgauss.video import FitConfig, FitDiverged, LearningRates, fit_steps
from foldgauss.video.fitting.state import to_model

RATES = tuple(field.name for field in dataclasses.fields(LearningRates))
#: What is searched, and in which range: factors for the fields of `LearningRates`, values for fields of `FitConfig`.
SPACE: dict[str, BaseDistribution] = {
    **dict.fromkeys(RATES, FloatDistribution(0.25, 4.0, log=True)),
    "final_rate": FloatDistribution(0.01, 0.5, log=True),
    "ssim_fraction": FloatDistribution(0.0, 0.5),
    "l2_fraction": FloatDistribution(0.0, 0.8),
    "cooldown_fraction": FloatDistribution(0.0, 0.6),
    "error_fraction": FloatDistribution(0.0, 0.6),
    "relocated_fraction": FloatDistribution(0.0, 0.15),
    "degree": IntDistribution(1, 3),
}
DEFAULT = FitConfig(degree=FitConfig().fold_degree)
TRIALS, NAME = 50, "foldgauss"
#: States of trials that count: those of a diverging fit are pruned.
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
#: The fit by which a process is prepared: frames that are large enough for all levels of resolution.
WARM_UP_SIZE, WARM_UP_GAUSSIANS, WARM_UP_STEPS = (128, 128), 100, 20
#: Rows of the table of trials.
BEST_SHOWN = 10


class Candidate(NamedTuple):
    """One fit of a trial."""

    source: ClipSource
    config: FitConfig


# ------------------------------------------------------------------------------------------------ one trial


def default_parameters() -> dict[str, float]:
    return {name: 1.0 if name in RATES else getattr(DEFAULT, name) for name in SPACE}


def configuration(parameters: dict[str, float], cpu_seconds: float, gaussians: int | None) -> FitConfig:
    """The settings of a trial; what is not among its parameters is the default."""
    rates = LearningRates()
    scaled = {name: getattr(rates, name) * parameters[name] for name in RATES if name in parameters}
    others = {name: value for name, value in parameters.items() if name not in RATES}
    rates = dataclasses.replace(rates, **scaled)
    return FitConfig(minutes=cpu_seconds / 60, num_gaussians=gaussians, rates=rates, **others)


@functools.cache
def prepare_process(num_frames: int) -> None:
    """A fit that does not count: JAX compiles for each number of frames, in 0.7 s of CPU time of a first fit."""
    frames = np.random.default_rng(0).integers(0, 256, (num_frames, *WARM_UP_SIZE, 3), np.uint8)
    for _ in fit_steps(frames, FitConfig(num_gaussians=WARM_UP_GAUSSIANS, steps=WARM_UP_STEPS)):
        pass


def fit_candidate(candidate: Candidate) -> Run:
    """The quality of a fit, or only that it diverged: `FitDiverged` itself does not pass between processes."""
    clip, config = candidate.source.read(), candidate.config
    prepare_process(clip.num_frames)
    try:
        for state, info in fit_steps(clip.frames, config, clock=time.process_time):
            pass
    except FitDiverged as error:
        return {"diverged": str(error)}
    model = to_model(state, config, clip.size, clip.fps)
    run = scores(model, clip.frames, with_ssim=False)
    return run | {"gaussians": model.num_gaussians, "steps": info.step, "cpu_seconds": info.seconds}


@contextmanager
def processes(jobs: int) -> Iterator[Callable[[Callable, Iterable], Iterable]]:
    """A `map` over `jobs` processes of one thread each; with one job, in this process."""
    if jobs == 1:
        try:
            set_num_threads(1)
            yield map
        finally:
            set_num_threads(None)
        return
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), initializer=set_num_threads, initargs=(1,))
    try:
        yield pool.map
    finally:
        pool.shutdown(cancel_futures=True)


# ------------------------------------------------------------------------------------------------ the study


def open_study(path: Path | None, setting: dict[str, object]) -> optuna.Study:
    """The study in `path`, or a new one. Raises ValueError for one of another setting, and for other files."""
    url = None if path is None else f"sqlite:///{path.resolve()}"
    try:
        study = optuna.create_study(storage=url, study_name=NAME, direction="maximize", load_if_exists=True)
    except Exception as error:  # of SQLAlchemy, or of Optuna, by what is in the file
        raise ValueError(f"--study: expected a SQLite file of Optuna, got {path}. Choose another name.") from error
    kept = study.user_attrs.get("setting")
    if kept is None:
        study.set_user_attr("setting", setting)
    elif kept != setting:
        other = ", ".join(name for name in {**kept, **setting} if kept.get(name) != setting.get(name))
        raise ValueError(f"--study: {path} is of another setting: {other}. Choose another file, or the same options.")
    return study


def repeat_interrupted(study: optuna.Study) -> None:
    """Mark trials that an ended process left running as failed, and enqueue their settings again."""
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
        study.enqueue_trial(trial.system_attrs.get("fixed_params", {}) | trial.params)


def make_sampler(seed: int, num_finished: int) -> optuna.samplers.BaseSampler:
    """A sampler for one trial: a continued search must not draw the first random numbers again."""
    return optuna.samplers.TPESampler(seed=int(np.random.SeedSequence([seed, num_finished]).generate_state(1)[0]))


def search(
    study: optuna.Study,
    space: dict[str, BaseDistribution],
    num_trials: int,
    seed: int,
    run_trial: Callable[[dict[str, float]], dict[str, Run]],
) -> None:
    """Trials until there are `num_trials` finished ones; `run_trial` gives the runs of a trial's clips by name."""
    repeat_interrupted(study)
    if not study.get_trials(states=(*FINISHED, TrialState.WAITING)):
        study.enqueue_trial({name: value for name, value in default_parameters().items() if name in space})
    while (num_finished := len(study.get_trials(states=FINISHED))) < num_trials:
        study.sampler = make_sampler(seed, num_finished)
        trial = study.ask(space)
        runs = run_trial(trial.params)
        trial.set_user_attr("clips", runs)
        if any("diverged" in run for run in runs.values()):
            study.tell(trial, state=TrialState.PRUNED)
        else:
            study.tell(trial, statistics.fmean(run["psnr"] for run in runs.values()))
        _tell(study.trials[trial.number], num_trials)


def _tell(trial: FrozenTrial, num_trials: int) -> None:
    value = "diverged" if trial.value is None else f"{trial.value:.3f} dB"
    text = f"trial {trial.number} (of {num_trials}): {value}, {describe(trial.params)}"
    console.print(text, style="dim", soft_wrap=True)


def describe(parameters: dict[str, float]) -> str:
    """Those parameters that are not the defaults, in words."""
    defaults = default_parameters()
    changed = {name: value for name, value in parameters.items() if value != defaults[name]}
    words = (f"{name} {'x' if name in RATES else ''}{value:.3g}" for name, value in changed.items())
    return ", ".join(words) or "defaults"


# ------------------------------------------------------------------------------------------------ results


def default_trial(study: optuna.Study) -> FrozenTrial:
    """The first finished trial with the default settings. Raises SystemExit where its fits diverged."""
    finished = study.get_trials(states=FINISHED)
    first = next(trial for trial in finished if describe(trial.params) == "defaults")
    if first.value is None:
        raise SystemExit("The fit with the default settings diverged: there is nothing to compare with.")
    return first


def clip_gains(trial: FrozenTrial, default: FrozenTrial) -> dict[str, float]:
    """dB above the default settings, by clip."""
    runs, base = trial.user_attrs["clips"], default.user_attrs["clips"]
    return {name: runs[name]["psnr"] - base[name]["psnr"] for name in base}


def show_trials(completed: list[FrozenTrial], default: FrozenTrial) -> None:
    """The best trials, and the default settings among them."""
    ranked = sorted(completed, key=lambda trial: -trial.value)
    shown = [trial for k, trial in enumerate(ranked) if k < BEST_SHOWN or trial.number == default.number]
    table = _common.table(f"Best of {len(completed)} trials", "trial", "PSNR, dB", "gain", "least gain", "settings")
    table.columns[-1].justify = "left"
    for trial in shown:
        gain, least = trial.value - default.value, min(clip_gains(trial, default).values())
        numbers = f"{trial.value:.3f}", f"{gain:+.3f}", f"{least:+.3f}"
        table.add_row(str(trial.number), *numbers, describe(trial.params))
    console.print(table)


def show_clips(best: FrozenTrial, default: FrozenTrial) -> None:
    columns = "default: PSNR, dB", "worst frame", "steps", "best: PSNR, dB", "worst frame", "steps", "gain"
    table = _common.table(f"Clips with the default settings, and with those of trial {best.number}", "clip", *columns)
    for name, gain in clip_gains(best, default).items():
        runs = (trial.user_attrs["clips"][name] for trial in (default, best))
        cells = (
            cell for run in runs for cell in (f"{run['psnr']:.2f}", f"{run['worst_psnr']:.2f}", f"{run['steps']:,}")
        )
        table.add_row(name, *cells, f"{gain:+.3f}")
    console.print(table)


def show_settings(best: FrozenTrial) -> None:
    table = _common.table(f"Settings of trial {best.number}", "setting", "default", "best")
    for name, value in best.params.items():
        default = getattr(LearningRates() if name in RATES else DEFAULT, name)
        table.add_row(name, f"{default:.3g}", f"{default * value if name in RATES else value:.3g}")
    console.print(table)


def figures_of(best: FrozenTrial, default: FrozenTrial) -> dict[str, float]:
    gains = {f"gain_{name}": gain for name, gain in clip_gains(best, default).items()}
    return {"psnr_default": default.value, "psnr_best": best.value, "gain": best.value - default.value} | gains


def records(study: optuna.Study) -> list[dict[str, object]]:
    """The finished trials, for the file of figures."""
    trials = study.get_trials(states=FINISHED)
    return [
        {"number": each.number, "psnr": each.value, "parameters": each.params, "clips": each.user_attrs["clips"]}
        for each in trials
    ]


# ------------------------------------------------------------------------------------------------ the command


def sources_of(options: argparse.Namespace) -> list[ClipSource]:
    """The clips, at the size and length asked for. Raises SystemExit where there are none."""
    found = sample_sources(dict.fromkeys(options.samples or ()))
    found += folder_sources(options.clips) if options.clips is not None else []
    if not found:
        raise SystemExit("No clips: give --clips FOLDER, or --samples with some of " + ", ".join(SAMPLE_SIZES) + ".")
    names = [source.name for source in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SystemExit(f"--clips: expected other names than those of --samples, got {', '.join(twice)}.")
    return [source._replace(size=options.size or source.size, frames=options.frames) for source in found]


def setting_of(options: argparse.Namespace, sources: list[ClipSource]) -> dict[str, object]:
    """What all trials of a study have in common, as it is read back from JSON."""
    defaults = dataclasses.asdict(configuration({}, options.cpu_seconds, options.gaussians))
    setting = {"clips": [source.describe() for source in sources], "searched": sorted(options.only)}
    return json.loads(json.dumps(setting | {"seed": options.seed, "config": defaults}))


def main(arguments: list[str] | None = None) -> None:
    parser = _parser()
    options = _common.parse(parser, arguments)
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    sources = sources_of(options)
    setting, space = setting_of(options, sources), {name: SPACE[name] for name in SPACE if name in options.only}
    with ExitStack() as stack:
        try:
            if options.study is not None:
                check_writable(options.study)
                stack.enter_context(hold_lock(options.study.with_name(options.study.name + ".lock")))
            study = open_study(options.study, setting)
        except LockHeld:
            parser.error(f"--study: {options.study} is used by another search")
        except (OSError, ValueError) as error:
            parser.error(str(error))
        run_each = stack.enter_context(processes(options.jobs))

        def run_trial(parameters: dict[str, float]) -> dict[str, Run]:
            config = configuration(parameters, options.cpu_seconds, options.gaussians)
            runs = run_each(fit_candidate, [Candidate(source, config) for source in sources])
            return {source.name: run for source, run in zip(sources, runs, strict=True)}

        search(study, space, options.trials, options.seed, run_trial)
        report(study, setting, options.json)


def report(study: optuna.Study, setting: dict[str, object], path: Path | None) -> None:
    """Print the tables, and write the figures to `path`."""
    default, best = default_trial(study), study.best_trial
    show_trials(study.get_trials(states=(TrialState.COMPLETE,)), default)
    show_clips(best, default)
    show_settings(best)
    facts, found = _common.describe_machine(), records(study)
    _common.finish(path, figures_of(best, default), facts, setting=setting, best=best.params, trials=found)


def _parser() -> argparse.ArgumentParser:
    parser = _common.parser(__doc__)
    parser.add_argument("--clips", type=Path, metavar="FOLDER", help="whose subfolders of images are the clips")
    parser.add_argument("--samples", nargs="+", choices=tuple(SAMPLE_SIZES), help="sample clips [none]")
    parser.add_argument("--cpu-seconds", type=positive, required=True, metavar="S", help="CPU time of each fit")
    parser.add_argument("--trials", type=_common.whole, default=TRIALS, metavar="N", help=f"in all [{TRIALS}]")
    parser.add_argument("--study", type=Path, metavar="FILE", help="SQLite file of trials, continued if it is there")
    parser.add_argument("--jobs", type=_common.whole, default=1, metavar="J", help="processes for a trial's clips [1]")
    parser.add_argument(
        "--only", nargs="+", choices=tuple(SPACE), default=tuple(SPACE), metavar="NAME", help=f"[{', '.join(SPACE)}]"
    )
    parser.add_argument("--gaussians", type=_common.whole, metavar="N", help="[by the clip]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", help="of all clips [each its own]")
    parser.add_argument("--frames", type=_common.whole, metavar="N", help="only the first N of each clip [all]")
    parser.add_argument("--seed", type=int, default=0, help="of the sampler [0]")
    return parser


if __name__ == "__main__":
    main()
