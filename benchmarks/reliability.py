"""What a long fit has to bear: kills, long clips, and half an hour without growing.

    python -m benchmarks.reliability kills [--kills N] [--fits NAME ...] [--seed N] [--json FILE]
    python -m benchmarks.reliability outputs [--seed N] [--json FILE]
    python -m benchmarks.reliability long [--frames N] [--size HxW] [--gaussians N] [--steps N] [--json FILE]
    python -m benchmarks.reliability soak [--minutes N] [--json FILE]

* kills: fits, plain and growing, each ended by SIGKILL N times, [25] and resumed each time by the same command. A
  half of the kills comes at random times of the life of a fit, start-up included, a third at a random byte or another
  moment of the writing of a checkpoint, a sixth in that of the model. After each one what lies there must be whole, and
  each model that a fit ends with must be that of a fit left in peace, bit for bit, with no other file beside it.
* outputs: `render`, `evaluate`, `compress`, `edit`, `export` killed while they write, an older output in the place:
  there must be that or the whole new one; `tradeoff` and `uncertainty` killed in a file of their folder: called again
  they must come to their end.
* long: 2,000 frames of 320x640 through `fit`, `evaluate` and `render`: the largest resident set of each beside a bound,
  which is a fraction of the frames' bytes and a constant (`_long.bound`).
* soak: fits of all kinds, kept, resumed, saved, rendered, one after another beside one that lasts throughout, all in
  one process whose resident set is looked at every 2 s; a line through it after the first quarter of the time. Linux.
"""

import argparse
import tempfile
from pathlib import Path

from benchmarks import _common, _kills, _long, _outputs, _soak
from benchmarks._common import console


def tell(text: str) -> None:
    console.print(text, style="dim", soft_wrap=True)


def kills(options: argparse.Namespace, folder: Path) -> None:
    """`Wrong` is raised where a file is damaged."""
    rows, shown = [], []
    for name in options.fits:
        own, ended = _kills.run(name, options.kills, options.seed, folder, tell)
        aimed = sum(row["aim"] != "time" for row in own)
        shown.append((name, len(own), aimed, sum(bool(row["in_write"]) for row in own), ended))
        rows += own
    columns = "fit", "kills", "aimed at a write", "found in a write", "fits that ended bit-identical"
    _common.print_table("kills", columns, shown)
    _common.finish(options.json, {"kills": len(rows)}, kills=rows)


def outputs(options: argparse.Namespace, folder: Path) -> None:
    """`Wrong` is raised where an output is damaged."""
    rows = _outputs.run(options.seed, tell, folder)
    columns = "output", "ending", "moment", "found", "left"
    _common.print_table("killed while it was written", columns, ([row[column] for column in columns] for row in rows))
    _common.finish(options.json, {"kills": len(rows)}, kills=rows)


def long(options: argparse.Namespace, folder: Path) -> None:
    frame_bytes = options.frames * 3 * options.size[0] * options.size[1]
    _long.write_clip(folder / "clip.avi", options.frames, options.size)
    ran = _long.long_clip(folder / "clip.avi", folder, options.gaussians, options.steps)
    figures = {"frames_mib": frame_bytes / 2**20}
    for name, own in ran.items():
        most = _long.bound(name, frame_bytes, options.gaussians)
        figures |= {f"{name}_seconds": own.seconds, f"{name}_mib": own.peak / 2**20, f"{name}_bound_mib": most / 2**20}
    _common.finish(options.json, figures, lines=ran["fit"].lines, size=options.size, frames=options.frames)


def soak(options: argparse.Namespace, folder: Path) -> None:
    with _soak.sampling() as samples:
        cycles = _soak.soak(options.minutes, folder, tell)
    figures = {"minutes": options.minutes, "cycles": len(cycles), "samples": len(samples)}
    for field in ("resident", "anonymous"):
        slope, error, level = _soak.trend(_soak.by_cycle(samples, cycles, field))
        figures |= {f"{field}_mib": level, f"{field}_mib_per_hour": slope, f"{field}_standard_error": error}
    _common.finish(options.json, figures, series=[sample._asdict() for sample in samples])


KINDS = {"kills": kills, "outputs": outputs, "long": long, "soak": soak}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("what", choices=KINDS)
    parser.add_argument("--kills", type=_common.whole, default=25, help="of each fit [25]")
    parser.add_argument("--fits", nargs="+", choices=_kills.FITS, default=list(_kills.FITS), help="[all]")
    parser.add_argument("--seed", type=int, default=0, help="of the kills [0]")
    parser.add_argument("--frames", type=_common.whole, default=2000, help="of the long clip [2000]")
    parser.add_argument("--size", type=_common.parse_size, metavar="HxW", default=(320, 640), help="of it [320x640]")
    parser.add_argument("--gaussians", type=_common.whole, default=80_000, help="of its model [80000]")
    parser.add_argument("--steps", type=_common.whole, default=300, help="of its fit [300]")
    parser.add_argument("--minutes", type=_common.positive, default=30.0, help="of the soak [30]")
    options = _common.parse(parser, arguments)
    with tempfile.TemporaryDirectory() as folder:
        KINDS[options.what](options, Path(folder))


if __name__ == "__main__":
    main()
