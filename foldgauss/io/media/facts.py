"""What one pass through a clip finds besides its frames, from which the rate and the notes of any range follow."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Int

from foldgauss.io.media.clip import Stretch, format_range
from foldgauss.io.media.frame_rate import FrameRate, describe_rate, estimate_rate, make_increasing


@dataclass(frozen=True, eq=False)
class ClipFacts:
    """What a pass finds; positions count the frames of the file, those lost to damage included.

    `kind`: a video, a folder of images, or an animation or one image ("pictures"). `fps`: the rate that the clip
    declares, or a default; None where its frames have durations of their own. `num_total`: the number of frames, lost
    ones included. Of all frames decoded, from the first of the file on, `positions`, and `stamps` in units of
    `time_base` seconds. `end`: when the last of these ends, in seconds; 0 where that is unknown. `notes`: about the
    whole clip. `threads`: of the decoder. `damaged`, `resized`: the positions of frames that decode with errors, and of
    those of another size than the video. `stretched`: as of `Clip`. `names`: of the images of a folder.
    """

    kind: Literal["video", "folder", "pictures"]
    fps: float | None
    num_total: int
    positions: Int[np.ndarray, " num_decoded"]
    stamps: Int[np.ndarray, " num_decoded"]
    time_base: float
    end: float = 0.0
    notes: list[str] = field(default_factory=list)
    threads: int = 0
    damaged: list[int] = field(default_factory=list)
    resized: list[int] = field(default_factory=list)
    stretched: Stretch | None = None
    names: list[str] = field(default_factory=list)

    def describe_span(
        self, first: int, end: int, start: int, stop: int | None, fps: float | None = None
    ) -> tuple[int, FrameRate, tuple[str, ...]]:
        """Number of frames that the clip has from position `start` up to `stop`, their rate, unless `fps` is given, and
        notes. Those that decode are the numbers `first` up to `end` of all frames decoded."""
        stop_within = self.num_total if stop is None else min(stop, self.num_total)
        places, num_declared, notes = self.positions[first:end], stop_within - start, []
        if stop is not None and stop > stop_within:
            used = f"the clip ends at {stop_within}: {format_range(start, stop_within)} are used."
            notes.append(f"frames {format_range(start, stop)} were asked for, and {used}")
        if end - first < num_declared:
            notes.append(f"only {end - first} of {num_declared} frames decode; those are used.")
        notes += self.notes
        lost = np.setdiff1d(np.arange(start, places[-1]), places).tolist()
        within = range(places[0], places[-1] + 1)
        notes += _describe_few(lost, "lost to damage and left out; what follows may show artifacts")
        notes += _describe_few([one for one in self.damaged if one in within], "damaged, and may show artifacts")
        resized = [one for one in self.resized if one in within]
        notes += _describe_few(resized, "of another size than the video, and stretched to it")
        rate = self._find_rate(first, end) if fps is None else FrameRate(fps)
        return num_declared, rate, (*notes, *describe_rate(rate))

    def _find_rate(self, first: int, end: int) -> FrameRate:
        """The rate of the frames with the numbers `first` up to `end`."""
        seconds, last = make_increasing((self.stamps * self.time_base).tolist(), self.fps), self.end
        if end < len(seconds):  # until the next one is shown, unless others were lost before it
            last = float(seconds[end]) if self.positions[end] == self.positions[end - 1] + 1 else 0.0
        fps = self.fps or (end - first) / (last - seconds[first])
        rate = estimate_rate(seconds[first:end], fps, last)
        if self.kind == "video":
            rate = rate._replace(first_second=float(seconds[first] - seconds[0]))
        if np.ptp(self.stamps[:end]) == 0 and end > 1:  # a raw stream: the rate is FFmpeg's guess
            rate = rate._replace(guessed=True)
        return rate


def _describe_few(positions: list[int], what: str) -> tuple[str, ...]:
    """A note about frames at these positions; `what`: their property, as a predicate without its verb."""
    if not positions:
        return ()
    which = f"frame {positions[0]} is"
    which = which if len(positions) == 1 else f"{len(positions):,} frames, the first of them {positions[0]}, are"
    return (f"{which} {what}.",)
