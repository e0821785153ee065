"""The paper's two tables on DAVIS, on a copy of the data set that is already here.

    python -m benchmarks.davis --root DIR [--json FILE] [--sequences NAME,NAME,..] [--table 1|2 ...]
                               [--minutes M | --steps N] [--preset paper|standard|draft] [--gaussians N]
                               [--frames A:B] [--crop HxW] [--seed S]

`--root` is the folder that the archive unpacks to, with `JPEGImages/480p` and `JPEGImages/Full-Resolution` (or `1080p`,
as in DAVIS 2016) in it; nothing is downloaded. Table 1 (table:sota-comparison) has 7 sequences, at full size and at
480p, table 2 (vr_davis) 11 at full size, of which the window of 960x1920 in the middle is taken. `--sequences` keeps
those named.

Each is fitted with the default's preset for 10 minutes, or as said, and evaluated on the same frames: PSNR and SSIM of
8-bit pictures, mean over all frames. The paper's figures stand beside ours, for every method that it lists; its own
fits took 30,000 steps on a graphics card. What is missing is named and left out, and averages are then over what is
there, the paper's beside ours too. With --json each fit that is done is kept there, and the same command goes on after
it.
"""

import argparse
import dataclasses
import functools
import statistics
from pathlib import Path

from benchmarks import _common
from benchmarks._common import console
from benchmarks._runs import Run, Runs, fitted
from foldgauss.io.datasets import davis
from foldgauss.video import FitConfig
from foldgauss.video.fitting.config import PRESETS

MINUTES = 10.0
#: Window of the second table.
CROP = (960, 1920)
#: Names of the folders of small frames.
SMALL = ("480p",)
#: Names of the folders of full frames: DAVIS 2017, DAVIS 2016.
FULL = ("Full-Resolution", "1080p")


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of the paper: (PSNR, SSIM) by method and sequence, its own average last; SSIM None where not given."""

    label: str
    sequences: tuple[str, ...]  # as DAVIS calls them
    paper: dict[str, tuple[tuple[float, float | None], ...]]
    parts: dict[str, tuple[tuple[str, ...], str]]  # our rows: folders, and the paper's method beside which they stand
    cropped: bool


def _psnr_alone(*values: float) -> tuple[tuple[float, None], ...]:
    return tuple((value, None) for value in values)


def _pairs(*values: float) -> tuple[tuple[float, float], ...]:
    return tuple(zip(values[::2], values[1::2], strict=True))


TABLES = {
    1: Table(
        label="table:sota-comparison",
        sequences=("bear", "cows", "elephant", "breakdance-flare", "train", "camel", "kite-surf"),
        paper={
            "Omnimotion": _psnr_alone(22.96, 23.93, 26.59, 24.45, 22.85, 23.98, 23.72, 24.07),
            "CoDeF": _psnr_alone(29.17, 28.82, 30.50, 25.99, 26.53, 26.10, 27.17, 27.75),
            "VGR": _psnr_alone(30.17, 28.24, 29.82, 27.18, 28.09, 27.74, 27.82, 28.44),
            "VeGaS-Full": _psnr_alone(31.79, 27.64, 30.93, 29.37, 31.20, 30.76, 35.84, 31.08),
            "VeGaS-480p": _psnr_alone(33.23, 30.27, 33.28, 33.19, 32.86, 32.23, 38.23, 33.31),
        },
        parts={"Full": (FULL, "VeGaS-Full"), "480p": (SMALL, "VeGaS-480p")},
        cropped=False,
    ),
    2: Table(
        label="vr_davis",
        sequences=(
            *("blackswan", "bmx-bumps", "bmx-trees", "breakdance", "camel", "car-roundabout", "car-shadow", "car-turn"),
            *("cows", "dance-twirl", "dog"),
        ),
        paper={
            "NeRV": _pairs(
                *(28.48, 0.812, 29.42, 0.864, 26.24, 0.789, 26.45, 0.915, 24.81, 0.781, 24.68, 0.857, 26.41, 0.871),
                *(27.45, 0.813, 22.55, 0.702, 25.79, 0.797, 28.17, 0.795, 26.40, 0.818),
            ),
            "E-NeRV": _pairs(
                *(29.38, 0.867, 28.90, 0.851, 27.26, 0.876, 28.33, 0.941, 25.85, 0.844, 26.01, 0.912, 30.41, 0.922),
                *(29.02, 0.888, 23.74, 0.819, 27.07, 0.864, 30.40, 0.882, 27.85, 0.879),
            ),
            "HNeRV": _pairs(
                *(30.35, 0.891, 29.98, 0.872, 28.76, 0.861, 30.45, 0.961, 26.71, 0.844, 27.75, 0.912, 31.32, 0.936),
                *(29.65, 0.879, 24.11, 0.792, 28.19, 0.845, 30.96, 0.898, 28.93, 0.881),
            ),
            "DNeRV": _pairs(
                *(30.92, 0.913, 30.59, 0.890, 29.63, 0.882, 30.88, 0.968, 27.38, 0.887, 29.35, 0.937, 31.95, 0.944),
                *(30.25, 0.892, 24.88, 0.827, 29.13, 0.870, 31.32, 0.905, 29.66, 0.901),
            ),
            "VeGaS": _pairs(
                *(34.92, 0.932, 33.01, 0.915, 31.78, 0.896, 32.27, 0.950, 31.12, 0.886, 32.75, 0.941, 36.41, 0.956),
                *(31.44, 0.852, 27.97, 0.834, 30.45, 0.850, 34.52, 0.914, 32.42, 0.902),
            ),
        },
        parts={"960x1920": (FULL, "VeGaS")},
        cropped=True,
    ),
}


def folder_of(root: Path, names: tuple[str, ...], sequence: str) -> str | None:
    """The first of the folders that has the sequence."""
    return next((name for name in names if (root / "JPEGImages" / name / sequence).is_dir()), None)


def measure(table: Table, wanted: set[str], options: argparse.Namespace, runs: Runs) -> dict[tuple[str, str], Run]:
    """Runs by part and sequence; those missing are named."""
    made, missing, crop = {}, [], options.crop if table.cropped else None
    for part, (names, _) in table.parts.items():
        for sequence in (name for name in table.sequences if name in wanted):
            folder = folder_of(options.root, names, sequence)
            if folder is None:
                missing.append(f"{names[0]}/{sequence}")
                continue
            # By what is fitted, so that a sequence which stands in both tables with one window is fitted once.
            name = f"{folder}/{sequence}" + (", window {}x{}".format(*crop) if crop else "")
            made[part, sequence] = runs.get(name, functools.partial(_run, sequence, folder, crop, options))
    if missing:
        console.print(f"{table.label}: not there, left out: {', '.join(missing)}", soft_wrap=True)
    return made


def _run(sequence: str, folder: str, crop: tuple[int, int] | None, options: argparse.Namespace) -> Run:
    clip = davis(options.root, sequence, folder, frames=options.frames, center_crop=crop).clip
    return fitted(clip, configuration(options))[1] | {"frames": clip.num_frames, "size": clip.size}


def configuration(options: argparse.Namespace) -> FitConfig:
    number = {"num_gaussians": options.gaussians} if options.gaussians else {}
    return FitConfig.preset(options.preset, **_common.budget(options), **number, seed=options.seed)


def rows(table: Table, made: dict[tuple[str, str], Run]) -> dict[str, dict[str, tuple[float, float | None]]]:
    """By method, ours below the paper's: (PSNR, SSIM) of the sequences that any part has, and of their average.

    The paper's average is its own where all sequences are there, and else the mean over those that are.
    """
    there = [name for name in table.sequences if any(sequence == name for _, sequence in made)]
    every = {}
    for method, values in table.paper.items():
        every[method] = {name: values[table.sequences.index(name)] for name in there}
        whole = len(there) == len(table.sequences)
        every[method]["average"] = values[-1] if whole else _mean(every[method].values())
    for part in table.parts:
        own = {name: (made[part, name]["psnr"], made[part, name]["ssim"]) for name in there if (part, name) in made}
        if own:
            every[f"here, {part}"] = own | {"average": _mean(own.values())}
    return every


def _mean(pairs) -> tuple[float, float | None]:
    psnr, ssim = zip(*pairs, strict=True)
    return statistics.fmean(psnr), None if None in ssim else statistics.fmean(ssim)


def show(table: Table, made: dict[tuple[str, str], Run]) -> dict[str, float]:
    """Print it, a line per sequence; returns our averages."""
    every = rows(table, made)
    lines = [*next(iter(every.values()))]
    shown = ((name, *(_cell(row.get(name)) for row in every.values())) for name in lines)
    _common.print_table(f"{table.label}: PSNR in dB, SSIM", ("sequence", *every), shown)
    figures = {}
    for part in (part for part in table.parts if f"here, {part}" in every):
        own = every[f"here, {part}"]
        psnr, ssim = own["average"]
        figures |= {f"psnr_{table.label}_{part}": psnr, f"ssim_{table.label}_{part}": ssim}
        beside = [every[table.parts[part][1]][name][0] for name in own if name != "average"]
        figures[f"above_paper_{table.label}_{part}"] = psnr - statistics.fmean(beside)
    return figures


def _cell(pair: tuple[float, float | None] | None) -> str:
    if pair is None:
        return "missing"
    psnr, ssim = pair
    return f"{psnr:.2f}" if ssim is None else f"{psnr:.2f} {ssim:.3f}"


def main(arguments: list[str] | None = None) -> None:
    parser = _common.fit_parser(__doc__, MINUTES)
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="DAVIS, as unpacked")
    parser.add_argument("--sequences", type=lambda text: set(text.split(",")), metavar="NAME,NAME,..", help="[all]")
    parser.add_argument("--table", type=int, choices=tuple(TABLES), action="append", help="[both]")
    parser.add_argument("--preset", choices=tuple(PRESETS), default="standard", help="[standard]")
    parser.add_argument("--crop", type=_common.parse_size, default=CROP, metavar="HxW", help="of table 2 [960x1920]")
    options = _common.parse(parser, arguments)
    chosen = [TABLES[number] for number in sorted(set(options.table or TABLES))]
    known = {name for table in chosen for name in table.sequences}
    wanted = options.sequences or known
    if wanted - known:
        parser.error(f"--sequences: expected some of {sorted(known)}, got {sorted(wanted - known)}")
    if not (options.root / "JPEGImages").is_dir():
        parser.error(f"--root: expected a folder with JPEGImages in it, got {options.root}")
    setting = {name: getattr(options, name) for name in ("preset", "gaussians", "frames", "seed")}
    runs, figures = Runs(options.json, setting | _common.budget(options)), {}
    for table in chosen:
        if made := measure(table, wanted, options, runs):
            figures |= show(table, made)
    runs.finish(figures)


if __name__ == "__main__":
    main()
