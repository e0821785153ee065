"""The command `uncertainty`."""

import csv
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from foldgauss import __version__
from foldgauss._runtime.checks import invalid
from foldgauss.cli.app.application import Stopped, WrongUse, app, err, out, warn, wrong_use
from foldgauss.cli.app.completion import complete_choice
from foldgauss.cli.measuring.profiles_file import is_profiles_file, load_profiles, save_profiles
from foldgauss.cli.shared.arguments import FittedClip, FittedFrames, ModelFile, Overwrite
from foldgauss.cli.shared.clips import read_fitted_clip, refuse_segments
from foldgauss.cli.shared.outputs import name_after, write_result
from foldgauss.cli.shared.rendering import TIME_LEFT
from foldgauss.io._atomic import OutputError, atomic_path, check_writable, output_error, resolve, write_or_keep
from foldgauss.io._lock import lock_output
from foldgauss.io.media.clip import Clip
from foldgauss.io.models.video_model import load_video_model, read_origin
from foldgauss.io.provenance import fingerprint
from foldgauss.uncertainty import (
    Increments,
    LikelihoodProfiles,
    frame_time_posterior,
    likelihood_profiles,
    marginalize_colors,
)
from foldgauss.uncertainty.diagnostics import plots
from foldgauss.uncertainty.diagnostics.irregularities import irregularities
from foldgauss.uncertainty.diagnostics.report import frame_table, summary
from foldgauss.uncertainty.likelihood.noise import NOISES
from foldgauss.uncertainty.posterior.optional_imports import import_optional
from foldgauss.uncertainty.posterior.result import FrameTimePosterior
from foldgauss.uncertainty.posterior.sampling import check_settings
from foldgauss.video.models.video_model import VideoModel

CHAINS, PROFILES = "chains.h5", "evidence.npz"
PLOTS = ("times.png", "increments.png", "correlation.png")
#: What the posterior is conditioned on: all splats, or all but their colors.
LEVELS = ("splats", "colors")
IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
FILES = ("frame_times.csv", "summary.md", "posterior.nc", *PLOTS)
#: Largest number of draws of each ensemble in posterior.nc, evenly spaced; all of them may take gigabytes.
MAX_DRAWS = 4000


@app.command(name="uncertainty")
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
    only: Annotated[
        str | None,
        typer.Option(
            metavar="K,A:B,..",
            help="Sample the times of these frames, with the others fixed [default: all but the first and last].",
        ),
    ] = None,
    noise: Annotated[
        str,
        typer.Option(
            help=f"Noise model of the residuals: {', '.join(NOISES)}; see docs/uncertainty.md.",
            autocompletion=complete_choice(NOISES),
        ),
    ] = "score",
    level: Annotated[
        str,
        typer.Option(
            help="Known parameters: splats, all of them; colors, all but the colors, which takes longer.",
            autocompletion=complete_choice(LEVELS),
        ),
    ] = "splats",
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
        import_optional(name)
    if noise not in NOISES:
        raise wrong_use("--noise", expected="one of " + ", ".join(NOISES), got=noise)
    if level not in LEVELS:
        raise wrong_use("--level", expected="one of " + ", ".join(LEVELS), got=level)
    out_dir = name_after(model_path, "-uncertainty") if out_dir is None else out_dir
    _check_folder(out_dir, video, overwrite)
    wanted = _parse_only(only)
    refuse_segments(model_path)
    model = load_video_model(model_path)
    if not isinstance(model, VideoModel):
        cure = "Give the model before the edit, and the clip that it was fitted to."
        raise wrong_use("MODEL", expected="a fitted model", got=f"{model_path}, an edited one", cure=cure)
    clip = read_fitted_clip(model, model_path, video, frames, same_number=False)
    if clip.num_frames != model.num_frames and read_origin(model_path).get("clip") == Path(clip.source).name:
        expected = f"the {model.num_frames} frames that the model was fitted to: its first is at 0 and its last at 1"
        cure = "To sample the times of some of them: --only A:B."
        raise wrong_use("--frames", expected=expected, got=f"{clip.num_frames} of this clip", cure=cure)
    _check_settings(clip.num_frames, wanted, concentration, ensembles, steps, seed)
    key = _digest_inputs(model_path, clip, noise, level, wanted if level == "colors" else None)
    context.with_resource(_create_folder(out_dir))
    own = tuple(out_dir / name for name in (*FILES, PROFILES))
    context.with_resource(lock_output(out_dir / CHAINS, own=own, what="run of uncertainty"))
    profiles = load_profiles(out_dir / PROFILES, key, clip.num_frames)
    if profiles is None and (out_dir / CHAINS).exists() and not overwrite:
        raise _other_draws(out_dir / CHAINS)
    with _bars() as bars:
        if profiles is not None:
            for note in profiles.notes:
                warn(note)
        else:
            profiles = _compute_profiles(model, clip, noise, level, wanted, bars)
            write_or_keep(out_dir / PROFILES, lambda path: save_profiles(path, key, profiles))
        settings = {"concentration": concentration, "ensembles": ensembles, "steps": steps, "seed": seed}
        posterior = _sample(out_dir / CHAINS, overwrite, bars, profiles=profiles, frames=wanted, **settings)
    fitted = np.asarray(model.frame_times.times(), np.float64) if model.num_frames == clip.num_frames else None
    title = f"{model_path.name}, by {Path(clip.source).name}"
    written = write_result(out_dir, lambda folder: _write(folder, posterior, fitted, title))
    _print_summary(written, posterior)


def _parse_only(text: str | None) -> list[int] | None:
    """Frames as 3,5,10:20."""
    if text is None:
        return None
    found: list[int] = []
    for part in text.split(","):
        first, colon, last = part.strip().partition(":")
        if not first.isdecimal() or (colon and not last.isdecimal()) or (colon and int(last) - int(first) > 100_000):
            expected = "frames as 3,5,10:20 (20 not included)"
            raise wrong_use("--only", expected=expected, got=repr(text))
        found += range(int(first), int(last)) if colon else [int(first)]
    if not found:
        raise wrong_use("--only", expected="at least one frame", got=repr(text))
    return sorted(set(found))


def _check_folder(folder: Path, video: Path, overwrite: bool) -> None:
    """Refuse a folder that cannot be used, before any work; it is created later."""
    if folder.exists() and not folder.is_dir():
        raise wrong_use("--out", expected="a folder", got=f"the file {folder}")
    if video.is_dir() and resolve(folder) == resolve(video):
        cure = "Plots would be frames there."
        raise wrong_use("--out", expected="a folder other than the clip's", got=folder, cure=cure)
    shown = [
        path for path in folder.glob("*") if not path.name.startswith(".")
    ]  # without temporary files of a killed run
    images = [path for path in shown if path.suffix.lower() in IMAGES and path.name not in PLOTS]
    if images:
        cure = "Plots would be frames there."
        raise wrong_use("--out", expected="a folder without other images", got=folder, cure=cure)
    there = [name for name in FILES if (folder / name).exists()]
    if (folder / PROFILES).exists() and not is_profiles_file(folder / PROFILES):  # a killed run may have left its own
        there.append(PROFILES)
    if there and not (folder / CHAINS).exists() and not overwrite:
        raise WrongUse(f"--out: {folder / there[0]} exists. Choose another folder, or add --overwrite.")
    if folder.is_dir():
        check_writable(folder / FILES[0])


@contextmanager
def _create_folder(path: Path) -> Iterator[None]:
    """Create the folder; one that was new and is still empty is removed at the end."""
    existed = path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"--out: cannot create the folder {path} ({error.strerror}). Choose another.") from error
    try:
        check_writable(path / FILES[0])
        yield
    finally:
        if not existed:
            with suppress(OSError):  # it is not empty
                path.rmdir()


def _check_settings(num_frames: int, only, concentration: float, ensembles: int, steps: int, seed: int) -> None:
    """Refuse invalid settings before anything is rendered."""
    try:
        Increments(np.linspace(0.0, 1.0, num_frames), only, concentration)
    except ValueError as error:
        if str(error).startswith("concentration"):
            raise
        if num_frames < 3:
            text = str(invalid("--frames", expected="at least 3 frames", got=num_frames))
        else:
            text = str(error).replace("frames:", "--only:", 1)
        raise WrongUse(text) from error
    check_settings(steps, ensembles, seed)


def _digest_inputs(model_path: Path, clip: Clip, noise: str, level: str, only: list[int] | None) -> str:
    """A digest of everything that the profiles depend on."""
    about = fingerprint(clip) | {"noise": noise, "level": level, "only": only, "version": __version__}
    digest = hashlib.blake2b(model_path.read_bytes(), digest_size=16)
    digest.update(json.dumps(about, sort_keys=True).encode())
    return digest.hexdigest()


def _compute_profiles(
    model: VideoModel, clip: Clip, noise: str, level: str, only: list[int] | None, bars
) -> LikelihoodProfiles:
    profiles = likelihood_profiles(
        model, clip.frames, noise=noise, on_render=lambda done, total: bars("pictures", done, total)
    )
    if level == "splats":
        return profiles
    return marginalize_colors(
        model, clip.frames, profiles, frames=only, on_frame=lambda done, total: bars("frames", done, total)
    )


def _other_draws(path: Path) -> WrongUse:
    cure = "Choose another folder, or add --overwrite to replace them."
    expected = "the draws of this model, clip and settings"
    return wrong_use("--out", expected=expected, got=f"others in {path}", cure=cure)


def _damaged_draws(path: Path) -> WrongUse:
    return WrongUse(f"--out: {path} is damaged. Remove it, or add --overwrite.")


@contextmanager
def _bars() -> Iterator[Callable[[str, int, int], None]]:
    """Progress bars of rendering and sampling, on a terminal."""
    columns = TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[text]}")
    with Progress(*columns, TimeElapsedColumn(), *TIME_LEFT, console=err, disable=not err.is_terminal) as progress:
        tasks: dict[str, Any] = {}
        titles = {"pictures": "Rendering", "frames": "Integrating colors", "steps": "Sampling"}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(titles.get(what, what.capitalize()), total=total, text="")
            progress.update(tasks[what], completed=done, total=total, text=f"{done:,}/{total:,}")

        yield show


def _sample(path: Path, overwrite: bool, bars, **arguments: Any) -> FrameTimePosterior:
    """Sample, from the draws of a stopped run if there are any; with `overwrite`, draws of another run are replaced."""
    existed, sampled = path.exists(), False

    def show(done: int, total: int) -> None:
        nonlocal sampled
        sampled = True
        bars("steps", done, total)

    def sample() -> FrameTimePosterior:
        return frame_time_posterior(on_progress=show, backend=path, **arguments)

    try:
        try:
            posterior = sample()
        except ValueError as error:
            if not str(error).startswith("backend:"):
                raise
            if not overwrite:
                if "damaged" in str(error):
                    raise _damaged_draws(path) from error
                raise _other_draws(path) from error
            path.unlink()
            existed, posterior = False, sample()
    except KeyboardInterrupt as error:
        raise Stopped(f"stopped; the same command continues from {path}.") from error
    except OSError as error:
        if error.filename is None or Path(error.filename) != path:
            raise
        again = f" The same command continues from {path}." if path.exists() else ""
        raise OutputError(f"{output_error(path, error)}{again}") from error
    if existed:
        text = "was complete: nothing was sampled" if not sampled else "was continued"
        out.print(f"{path}: {text}", soft_wrap=True)
    return posterior


def _write(folder: Path, posterior: FrameTimePosterior, fitted: np.ndarray | None, title: str) -> Path:
    """Write all files, each atomically, the most important ones first; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    flagged = irregularities(posterior)
    _write_table(folder / "frame_times.csv", frame_table(posterior, fitted))
    with atomic_path(folder / "summary.md") as temporary:
        text = summary(posterior, fitted, flagged=flagged)
        temporary.write_text(f"# Frame times of {title}\n\n{text}")
    _write_netcdf(folder / "posterior.nc", posterior)
    _save_plot(folder / "times.png", plots.plot_times, posterior, fitted=fitted, flagged=flagged)
    _save_plot(folder / "increments.png", plots.plot_increments, posterior, flagged=flagged)
    _save_plot(folder / "correlation.png", plots.plot_correlation, posterior.profiles)
    return folder


def _save_plot(path: Path, plot: Callable, *arguments: Any, **options: Any) -> None:
    from matplotlib import pyplot

    pyplot.switch_backend("Agg")  # needs no display
    figure = np.ravel(plot(*arguments, **options))[0].figure
    try:
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", dpi=120)
    finally:
        pyplot.close(figure)


def _write_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    with atomic_path(path) as temporary, open(temporary, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow([_cell(value) for value in row])


def _cell(value: Any) -> str:
    if isinstance(value, np.bool_):
        return "yes" if value else "no"
    if isinstance(value, np.integer):
        return str(value)
    return "" if np.isnan(value) else f"{value:.9g}"


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


def _print_summary(folder: Path, posterior: FrameTimePosterior) -> None:
    out.print((folder / "summary.md").read_text(), soft_wrap=True)
    if not posterior.converged:
        warn(f"{posterior.message} The draws so far are in {folder}.")
