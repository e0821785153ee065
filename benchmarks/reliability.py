"""What a long fit has to bear: kills, long clips, and half an hour without growing.

    python -m benchmarks.reliability kills [--kills N] [--fits NAME ...] [--seed N] [--json FILE]
    python -m benchmarks.reliability outputs [--seed N] [--json FILE]
    python -m benchmarks.reliability long [--frames N] [--size HxW] [--gaussians N] [--steps N] [--json FILE]
    python -m benchmarks.reliability soak [--minutes N] [--json FILE]

* kills: fits, plain and growing, each ended by SIGKILL N times, [25] and resumed each time with --resume. A
  half of the kills comes at random times of the life of a fit, start-up included, a third at a random byte or another
  moment of the writing of a checkpoint, a sixth in that of the model. After each one what lies there must be whole, and
  each model that a fit ends with must be that of a fit left in peace, bit for bit, with no other file beside it.
* outputs: `render`, `evaluate`, `compress`, `edit`, `export` killed while they write, an older output in the place:
  there must be that or the whole new one; `tradeoff` and `uncertainty` killed in a file of their folder: called again
  they must come to their end.
* long: 2,000 frames of 320x640 through `fit`, `evaluate` and `render`: the largest resident set of each beside a bound,
  which is a share of the frames' bytes and a constant (`_long.bound`); and whether the progress that the fit told was
  true.
* soak: fits of all kinds, kept, resumed, saved, rendered, one after another beside one that lasts throughout, all in
  one process whose resident set is looked at every 2 s; a line through it after the first quarter of the time. Linux.
"""

import tempfile
from collections import Counter
from pathlib import Path

from benchmarks import _common, _kills, _long, _outputs, _soak
from benchmarks._common import console
from benchmarks.memory import write_clip


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("what", choices=KINDS)
    parser.add_argument("--kills", type=_common.whole, default=25, help="of each fit [25]")
    parser.add_argument("--fits", nargs="+", choices=_kills.FITS, default=list(_kills.FITS), help="[all]")
    parser.add_argument("--seed", type=int, default=0, help="of the kills [0]")
    parser.add_argument("--frames", type=_common.whole, default=2000, help="of the long clip [2000]")
    parser.add_argument("--size", type=_common.size, metavar="HxW", default=(320, 640), help="of it [320x640]")
    parser.add_argument("--gaussians", type=_common.whole, default=80_000, help="of its model [80000]")
    parser.add_argument("--steps", type=_common.whole, default=300, help="of its fit [300]")
    parser.add_argument("--minutes", type=float, default=30.0, help="of the soak [30]")
    options = _common.parse(parser, arguments)
    KINDS[options.what](options)


def kills(options) -> None:
    wanted = dict.fromkeys(options.fits, options.kills)
    found = _kills.run(wanted, options.seed, lambda text: console.print(text, style="dim", soft_wrap=True))
    rows = found["rows"]
    table = _common.table("kills", "fit", "kills", "aimed at a write", "found in a write", "went on from a checkpoint")
    for name in wanted:
        own = [row for row in rows if row["fit"] == name]
        aimed, hit = sum(row["aim"] != "time" for row in own), sum(bool(row["in_write"]) for row in own)
        resumed = sum(row["goes_on_from"] == "its checkpoint" for row in own)
        table.add_row(name, *map(str, (len(own), aimed, hit, resumed)))
    console.print(table)
    lying = _common.table("unfinished files after a kill", "which, and how far it had come", "kills")
    for what, num in Counter(hit for row in rows for hit in row["in_write"]).items():
        lying.add_row(what, str(num))
    console.print(lying)
    figures = {"kills": len(rows), "in_write": sum(bool(row["in_write"]) for row in rows)}
    figures |= {f"from_{where.split()[-1]}": sum(row["goes_on_from"] == where for row in rows) for where in PLACES}
    figures |= {"fits_ended_bit_identical": found["ended"], "damaged_files": 0}  # or `Wrong` would have been raised
    _common.finish(options.json, figures, _common.describe_machine(), kills=rows)


#: Where a fit may go on from after a kill.
PLACES = ("the start", "its checkpoint", "the end")


def outputs(options) -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows = _outputs.run(options.seed, lambda text: console.print(text, style="dim", soft_wrap=True), Path(folder))
    table = _common.table("killed while it was written", "output", "moment", "found after it", "unfinished files left")
    for row in rows:
        table.add_row(row["output"], f"{row['moment']} {row['ending']}", row["found"], str(len(row["left"])))
    console.print(table)
    figures = {"kills": len(rows), "damaged_files": 0}  # or `Wrong` would have been raised
    _common.finish(options.json, figures, _common.describe_machine(), kills=rows)


def long(options) -> None:
    frame_bytes = options.frames * 3 * options.size[0] * options.size[1]
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.avi"
        write_clip(clip, options.frames, options.size)
        ran = _long.long_clip(clip, Path(folder), options.gaussians, options.steps)
    table = _common.table("a long clip", "command", "seconds", "peak, MiB", "bound, MiB", "frames as bytes, MiB")
    figures = {"frames_mib": frame_bytes / 2**20}
    for name, own in ran.items():
        most = _long.bound(name, frame_bytes, options.gaussians)
        table.add_row(name, *(f"{n:,.0f}" for n in (own.seconds, own.peak / 2**20, most / 2**20, frame_bytes / 2**20)))
        figures |= {f"{name}_seconds": own.seconds, f"{name}_mib": own.peak / 2**20, f"{name}_bound_mib": most / 2**20}
        figures[f"{name}_within"] = float(own.peak <= most)
    console.print(table)
    figures |= _long.progress(ran["fit"].lines)
    told = [{"at": at} | line for at, line in ran["fit"].lines]
    _common.finish(
        options.json, figures, _common.describe_machine(), lines=told, size=options.size, frames=options.frames
    )


def soak(options) -> None:
    with tempfile.TemporaryDirectory() as folder, _soak.sampling() as samples:
        cycles = _soak.soak(options.minutes, Path(folder), lambda text: console.print(text, style="dim"))
    table = _common.table("memory, MiB, mean of each cycle", "cycle ends (s)", "resident", "of it in no file")
    points = {field: _soak.by_cycle(samples, cycles, field) for field in ("resident", "anonymous")}
    for k, (_, last) in enumerate(cycles):
        table.add_row(f"{last:.0f}", *(f"{own[k][1]:.1f}" for own in points.values()))
    console.print(table)
    figures = {"minutes": options.minutes, "cycles": len(cycles), "samples": len(samples)}
    for field, own in points.items():
        line = _soak.trend(own)
        figures |= {f"{field}_mib": line.level, f"{field}_mib_per_hour": line.slope}
        figures |= {f"{field}_mib_per_hour_low": line.low, f"{field}_mib_per_hour_high": line.high}
    _common.finish(options.json, figures, _common.describe_machine(), series=[sample._asdict() for sample in samples])


KINDS = {"kills": kills, "outputs": outputs, "long": long, "soak": soak}


if __name__ == "__main__":
    main()
