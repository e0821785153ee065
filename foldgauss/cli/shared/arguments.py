"""Arguments and options that several commands take, and the parsing of their texts."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.checks import invalid, require
from foldgauss.cli.app.help import complete_choice
from foldgauss.io.media.clip import DEINTERLACE
from foldgauss.render import RenderOptions

#: Largest number of times, which at usual rates play for an hour.
MAX_TIMES = 100_000

#: Panel of `--help` for the constants of the renderer.
RENDERER = "Renderer"

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")]
FittedClip = Annotated[Path, typer.Argument(help="The clip that the model was fitted to.")]
NewClip = Annotated[
    Path,
    typer.Argument(help="Video file, folder of images in natural order, or one image."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing outputs.")]
Size = Annotated[str | None, typer.Option(metavar="HxW", help="Height x width in pixels, such as 160x320.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Frames A to B, without B; either may be omitted.")]
Levels = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Value of white in a clip of 16 bits, such as 4095 for data of 12 [default: 65535].",
        hidden=True,
    ),
]
Deinterlace = Annotated[
    str,
    typer.Option(
        metavar="HOW",
        help="Interlaced frames: frames, each becomes one; fields, two at twice the rate; refuse.",
        hidden=True,
        autocompletion=complete_choice(DEINTERLACE),
    ),
]
FittedFrames = Annotated[
    str | None,
    typer.Option(
        metavar="A:B",
        help="Frames A up to, not including, B of the clip, as many as the model has "
        "[default: those that it was fitted to].",
    ),
]
Times = Annotated[
    str | None,
    typer.Option(
        metavar="T,T,..|A:B:N", help="Times in [0, 1], or N times from A to B [default: those of the frames]."
    ),
]
AlphaCutoff = Annotated[
    float | None,
    typer.Option(
        help="Skip Gaussians where their alpha is below this [default: 1/255, or as fitted].",
        rich_help_panel=RENDERER,
    ),
]
SupportRadius = Annotated[
    float | None,
    typer.Option(
        help="Skip Gaussians beyond this many standard deviations [default: none, or as fitted].",
        rich_help_panel=RENDERER,
    ),
]
TransmittanceStop = Annotated[
    float | None,
    typer.Option(
        help="A pixel is finished once its transmittance is below this [default: 1e-4, or as fitted].",
        rich_help_panel=RENDERER,
    ),
]


def parse_size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    height, cross, width = text.lower().partition("x")
    require(
        cross and height.isdecimal() and width.isdecimal() and int(height) > 0 and int(width) > 0,
        "--size",
        expected="HxW with both at least 1, as 160x320",
        got=repr(text),
    )
    return int(height), int(width)


def parse_frames(text: str | None) -> tuple[int | None, int | None] | None:
    if text is None:
        return None
    first, colon, last = text.partition(":")
    require(
        colon and not any(part and not part.isdecimal() for part in (first, last)),
        "--frames",
        expected="A:B with whole numbers >= 0, as 0:24",
        got=repr(text),
    )
    return (int(first) if first else None), (int(last) if last else None)


def parse_color(text: str) -> tuple[float, float, float] | None:
    """None for "none"."""
    if text == "none":
        return None
    digits = text.removeprefix("#")
    require(
        re.fullmatch("[0-9a-fA-F]{6}", digits),
        "--background",
        expected="none, or six hexadecimal digits RRGGBB, as ffffff for white",
        got=repr(text),
    )
    return tuple(byte / 255 for byte in bytes.fromhex(digits))


def parse_times(text: str | None) -> np.ndarray | None:
    if text is None:
        return None
    expected = "numbers in [0, 1] as 0,0.5,1, or first:last:count as 0:1:50"
    try:
        if text.count(":") == 2:
            first, last, count = text.split(":")
            times = np.linspace(float(first), float(last), min(int(count), MAX_TIMES + 1))
        else:
            times = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise invalid("--times", expected=expected, got=text) from error
    require(0 < len(times) <= MAX_TIMES and ((times >= 0) & (times <= 1)).all(), "--times", expected=expected, got=text)
    return times


def override_constants(
    options: RenderOptions,
    alpha_cutoff: float | None,
    support_radius: float | None,
    transmittance_stop: float | None,
) -> RenderOptions:
    """`options` with the constants that are not None."""
    constants = {
        "alpha_cutoff": alpha_cutoff,
        "support_radius": support_radius,
        "transmittance_stop": transmittance_stop,
    }
    return dataclasses.replace(options, **{name: value for name, value in constants.items() if value is not None})


def refuse_together(option: str, others: Mapping[str, object]) -> None:
    """Raise where one of the `others`, values by option, is given beside `option`."""
    for other, value in others.items():
        require(value is None or value is False, option, expected=f"no {other}", got="both")
