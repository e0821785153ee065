"""The command `uncertainty`."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from foldgauss._runtime.checks import ParameterError, check_one_of, invalid, require
from foldgauss._runtime.optional_imports import import_optional
from foldgauss.cli.app.application import Stopped, command, out, warn
from foldgauss.cli.app.help import complete_choice
from foldgauss.cli.fitting.job_progress import describe_continuation
from foldgauss.cli.shared.arguments import FittedClip, FittedFrames, ModelFile, Overwrite
from foldgauss.cli.shared.console import choose_display, show_progress
from foldgauss.cli.shared.files import (
    make_folder,
    name_after,
    read_fitted_clip,
    refuse_foreign,
    refuse_inputs,
    refuse_segments,
)
from foldgauss.io._atomic import atomic_path, lock_output, translate_output_errors, write_or_keep
from foldgauss.io.figures import write_figure
from foldgauss.io.models.video_model import load_video_model, read_origin
from foldgauss.uncertainty import frame_time_posterior, likelihood_profiles
from foldgauss.uncertainty.diagnostics import plots
from foldgauss.uncertainty.diagnostics.irregularities import irregularities
from foldgauss.uncertainty.diagnostics.report import frame_table, summary
from foldgauss.uncertainty.likelihood.noise import NOISES
from foldgauss.uncertainty.posterior.log_prob import check_prior
from foldgauss.uncertainty.posterior.result import FrameTimePosterior
from foldgauss.uncertainty.posterior.sampling import check_settings
from foldgauss.video.models.video_model import VideoModel

CHAINS = "chains.h5"
PLOTS = ("times.png", "increments.png", "correlation.png")
FILES = ("frame_times.csv", "summary.md", "posterior.nc", *PLOTS)
#: Largest number of draws of each ensemble in posterior.nc, evenly spaced; all of them may take gigabytes.
MAX_DRAWS = 4000


@command("uncertainty")
def uncertainty_command(
    context: typer.Context,
    model_path: ModelFile,
    video: FittedClip,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder for tables, plots and draws [default: MODEL-uncertainty in this folder].",
        ),
    ] = None,
    frames: FittedFrames = None,
    noise: Annotated[
        str,
        typer.Option(
            help=f"Noise model of the residuals: {', '.join(NOISES)}; see docs/uncertainty.md.",
            autocompletion=complete_choice(NOISES),
        ),
    ] = "score",
    concentration: Annotated[
        float,
        typer.Option(
            help="Concentration of the Dirichlet prior on increments: 1 is uniform, more favors equal increments."
        ),
    ] = 1.0,
    ensembles: Annotated[int, typer.Option(help="Independent ensembles, compared by R-hat.")] = 4,
    steps: Annotated[
        int, typer.Option(help="Largest number of steps; sampling ends earlier once it has converged.")
    ] = 20_000,
    seed: Annotated[int, typer.Option(help="Seed of all draws.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Estimate the uncertainty of the frame times, given the splats.

    Writes error bars of every frame, duplicated and dropped frames, and convergence diagnostics. The same command
    continues a stopped run, or with more --steps a finished one.
    """
    for name in ("matplotlib", "emcee", "h5py", "h5netcdf", "arviz"):
        import_optional(name, "uncertainty")
    check_one_of("--noise", noise, NOISES)
    out_dir = name_after(model_path, "-uncertainty") if out_dir is None else out_dir
    refuse_inputs(out_dir / PLOTS[0], {"clip": video})  # plots would be frames there
    known, cure = overwrite or (out_dir / CHAINS).exists(), ", or start over with --overwrite"
    refuse_foreign(out_dir, (*FILES, CHAINS), "run of uncertainty", record=CHAINS, known=known, cure=cure)
    refuse_segments(model_path)
    model = load_video_model(model_path)
    require(
        isinstance(model, VideoModel),
        "MODEL",
        expected="a fitted model",
        got=f"{model_path}, an edited one",
        cure="Give the model before the edit, and the clip that it was fitted to.",
    )
    clip = read_fitted_clip(model, model_path, video, frames, same_number=False)
    require(
        clip.num_frames == model.num_frames or read_origin(model_path).get("clip") != Path(clip.source).name,
        "--frames",
        expected=f"the {model.num_frames} frames that the model was fitted to: its first is at 0 and its last at 1",
        got=f"{clip.num_frames} of this clip",
        cure="Give all of them; the tables have a row for each.",
    )
    require(clip.num_frames >= 3, "--frames", expected="at least 3 frames", got=clip.num_frames)
    check_prior(clip.num_frames, concentration)
    check_settings(steps, ensembles, seed)
    make_folder(out_dir)
    own = tuple(out_dir / name for name in FILES)
    context.with_resource(lock_output(out_dir / CHAINS, own=own, what="run of uncertainty"))
    with show_progress(choose_display()) as show:
        profiles = likelihood_profiles(
            model, clip.frames, noise=noise, on_render=lambda done, total: show("Rendering", done, total)
        )
        settings = {"concentration": concentration, "ensembles": ensembles, "steps": steps, "seed": seed}
        if overwrite:
            (out_dir / CHAINS).unlink(missing_ok=True)
        posterior = _sample(out_dir / CHAINS, show, overwrite, profiles=profiles, **settings)
    fitted = np.asarray(model.frame_times.times(), np.float64) if model.num_frames == clip.num_frames else None
    title = f"{model_path.name}, by {Path(clip.source).name}"
    written = write_or_keep(out_dir, lambda folder: _write(folder, posterior, fitted, title))
    out.print((written / "summary.md").read_text(), soft_wrap=True)
    if not posterior.converged:
        warn(f"{posterior.message} The draws so far are in {written}.")


def _sample(path: Path, show: Callable, overwrite: bool, **arguments: Any) -> FrameTimePosterior:
    """Sample, from the draws of a stopped run if there are any."""
    existed, sampled = path.exists(), False

    def on_steps(done: int, total: int) -> None:
        nonlocal sampled
        sampled = True
        show("Sampling", done, total)

    try:
        with translate_output_errors(path):
            posterior = frame_time_posterior(on_progress=on_steps, backend=path, **arguments)
    except ParameterError as error:
        if error.parameter != "backend":
            raise
        raise invalid(
            "--out",
            expected="the draws of this model, clip and settings",
            got=f"others in {path}, or damaged ones",
            cure="Choose another folder, or add --overwrite.",
        ) from error
    except KeyboardInterrupt as error:
        raise Stopped(f"stopped; the draws are in {path}. {describe_continuation(overwrite)}") from error
    if existed:
        text = "was complete: nothing was sampled" if not sampled else "was continued"
        out.print(f"{path}: {text}", soft_wrap=True)
    return posterior


def _write(folder: Path, posterior: FrameTimePosterior, fitted: np.ndarray | None, title: str) -> Path:
    """Write all files, each atomically, the most important ones first; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    flagged = irregularities(posterior)
    columns = frame_table(posterior, fitted)
    with atomic_path(folder / "frame_times.csv") as temporary:
        rows, header = np.stack([*columns.values()], axis=1), ",".join(columns)
        np.savetxt(temporary, rows, fmt="%.9g", delimiter=",", header=header, comments="")
    with atomic_path(folder / "summary.md") as temporary:
        text = summary(posterior, fitted, flagged=flagged)
        temporary.write_text(f"# Frame times of {title}\n\n{text}")
    _write_netcdf(folder / "posterior.nc", posterior)
    write_figure(
        folder / "times.png",
        lambda figure: plots.plot_times(posterior, figure.subplots(2, 1, sharex=True), fitted=fitted, flagged=flagged),
        (9, 6),
    )
    write_figure(
        folder / "increments.png",
        lambda figure: plots.plot_increments(posterior, figure.subplots(), flagged=flagged),
        (9, 4),
    )
    write_figure(
        folder / "correlation.png",
        lambda figure: plots.plot_correlation(posterior.profiles, figure.subplots()),
        (6, 3.6),
    )
    return folder


def _write_netcdf(path: Path, posterior: FrameTimePosterior) -> None:
    steps, walkers = posterior.times.shape[1:3]
    stride = -(-steps * walkers // MAX_DRAWS)
    thinned = dataclasses.replace(posterior, times=posterior.times[:, ::stride])
    data = thinned.to_arviz()
    data.attrs["kept_one_step_in"] = stride
    with atomic_path(path) as temporary:
        # Reserve the space first: HDF5 may crash on a full disk, where Python raises an error.
        temporary.write_bytes(bytes(2 * thinned.times.nbytes + (1 << 20)))
        data.to_netcdf(str(temporary), engine="h5netcdf")
