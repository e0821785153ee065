"""Arguments and options that several commands take, their parsing, and the times that options choose."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from foldgauss._runtime.checks import invalid, require
from foldgauss.cli.app.application import warn
from foldgauss.render import RenderOptions
from foldgauss.video.models.frame_times import played_positions, remapped_positions, times_at

#: Largest number of times, which at usual rates play for an hour.
MAX_TIMES = 100_000

#: Panel of `--help` for the constants of the renderer.
RENDERER = "Renderer"

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.")]
FittedClip = Annotated[Path, typer.Argument(help="The clip that the model was fitted to.")]
NewClip = Annotated[
    Path,
    typer.Argument(help="Video file, folder of images in natural order, one image, or model file, which is rendered."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing outputs.")]
Size = Annotated[str | None, typer.Option(metavar="HxW", help="Height x width in pixels, such as 160x320.")]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Frames A to B, without B; either may be omitted.")]
FittedFrames = Annotated[
    str | None,
    typer.Option(
        metavar="A:B",
        help="Frames A up to, not including, B of the clip, as many as the model has "
        "[default: those that it was fitted to].",
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


MAX_IMAGES = 10 * MAX_TIMES
#: The slowest playback, and the inverse of the fastest.
MIN_SPEED = 1e-4
#: The longest video that `--remap` makes.
MAX_SECONDS = 1e6
MAX_EVEN_FPS = 50.0  # frames per second, the most of a GIF: a constant rate is not made higher for short intervals


@dataclasses.dataclass(frozen=True)
class Timeline:
    """Chooses the rendered times and the frame rate; all but `fps` exclude each other.

    In the methods `fps` is the clip's rate. `seconds`, (num_frames + 1,), are the times at which its frames are shown,
    and the end, where they are not evenly spaced; `fps` is their mean rate then.
    """

    fps: float | None = None
    speed: float | None = None
    remap: list[tuple[float, float]] | None = None
    chosen: np.ndarray | None = None
    frame: int | None = None

    def __post_init__(self) -> None:
        given = [option for option, value in self.ways.items() if value is not None]
        if len(given) > 1:
            raise invalid(given[0], expected="one way to choose times", got=" and ".join(given))
        require(
            self.speed is None or MIN_SPEED <= abs(self.speed) <= 1 / MIN_SPEED,
            "--speed",
            expected=f"a number from {MIN_SPEED:g} to {1 / MIN_SPEED:g}, or the same below 0",
            got=self.speed,
        )

    @property
    def ways(self) -> dict[str, object]:
        """The values of the options that exclude each other."""
        return {"--speed": self.speed, "--remap": self.remap, "--times": self.chosen, "--frame": self.frame}

    @property
    def is_single(self) -> bool:
        """Whether one image is asked for."""
        return self.frame is not None or (self.chosen is not None and len(self.chosen) == 1)

    def rate(self, fps: float, seconds: np.ndarray | None = None) -> float:
        """Frames per second of the output.

        With `speed` and `remap`, a clip with `seconds` gets the rate of its shortest interval, up to `MAX_EVEN_FPS`.
        """
        if self.fps is None and seconds is not None and (self.speed is not None or self.remap is not None):
            return max(fps, min(float(1 / np.diff(seconds).min()), MAX_EVEN_FPS))
        return fps if self.fps is None else self.fps

    def stamps(self, seconds: np.ndarray | None) -> np.ndarray | None:
        """Seconds at which the output's images are shown, and the end: the clip's own, unless something is chosen."""
        return seconds if all(value is None for value in (self.fps, *self.ways.values())) else None

    def times(self, frame_times: np.ndarray, fps: float, seconds: np.ndarray | None = None) -> np.ndarray:
        """The model times to render, in order."""
        if self.chosen is not None:
            return self.chosen
        if self.frame is not None:
            num = len(frame_times)
            require(-num <= self.frame < num, "--frame", expected=f"a frame from {-num} to {num - 1}", got=self.frame)
            return frame_times[[self.frame]]
        if self.stamps(seconds) is not None:
            return frame_times
        rate = self.rate(fps, seconds) / fps
        if self.remap is not None:
            self._refuse_long("--remap", self.remap[-1][0] * fps * rate)
            positions = remapped_positions(self.remap, fps, rate)
            return times_at(frame_times, positions if seconds is None else _place(positions / fps, seconds))
        speed, length = self.speed or 1.0, len(frame_times) - 1 if seconds is None else seconds[-1] * fps
        if self.speed is not None or self.fps is not None:  # otherwise it has as many frames as the clip
            self._refuse_long("--fps" if self.speed is None else "--speed", length * rate / abs(speed))
        if seconds is not None:
            return times_at(frame_times, _place(_seconds_played(seconds, fps * rate, speed), seconds))
        return times_at(frame_times, played_positions(len(frame_times), rate, speed=speed))

    def warn_of_end(self, num_frames: int, fps: float, seconds: np.ndarray | None) -> None:
        """Warn if `remap` exceeds the clip."""
        last, end = 0.0, num_frames / fps if seconds is None else seconds[-1]
        if self.remap is not None:
            last = max(of_clip for _, of_clip in self.remap)
        if last > end * (1 + 1e-6):
            warn(
                f"--remap: expected seconds up to the end of the clip, {end:.4g}, got {last:.4g}. "
                "Its last frame is held from there on."
            )

    def _refuse_long(self, option: str, num_images: float) -> None:
        require(num_images <= MAX_IMAGES, option, expected=f"at most {MAX_IMAGES:,} images", got=f"{num_images:,.0f}")


def _seconds_played(seconds: np.ndarray, rate: float, speed: float) -> np.ndarray:
    """Evenly spaced seconds of the clip, until its end; backwards from its last frame on."""
    step = abs(speed) / rate
    if speed > 0:
        return np.arange(max(int(np.ceil(seconds[-1] / step - 1e-6)), 1)) * step
    return seconds[-2] - np.arange(int(seconds[-2] / step + 1e-6) + 1) * step


def _place(shown: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """The frame positions at seconds of the clip."""
    return np.interp(shown, seconds[:-1], np.arange(len(seconds) - 1))


def parse_remap(text: str | None) -> list[tuple[float, float]] | None:
    if text is None:
        return None
    pairs = [part.partition("=") for part in text.split(",")]
    try:
        points = [(float(shown), float(of_clip)) for shown, _, of_clip in pairs]
        if points[-1][0] > MAX_SECONDS:
            raise ValueError("too long")
        remapped_positions(points, fps=1.0)
    except ValueError as error:
        raise invalid(
            "--remap",
            expected="seconds shown = seconds of the clip, the former rising from 0, as 0=0,1=1,3=1,4=2",
            got=text,
        ) from error
    return points
