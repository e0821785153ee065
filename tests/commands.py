"""The command as the tests call it."""

import math
import wave
from pathlib import Path

import av
import numpy as np
import pytest

from foldgauss import cli


def run(*arguments):
    """Exit code of the command, run in this process."""
    with pytest.raises(SystemExit) as done:
        cli.main([str(argument) for argument in arguments])
    return done.value.code or 0


def write_tone(path: Path, seconds: float) -> Path:
    """A .wav file of 8000 samples per second; returns its path."""
    samples = 20_000 * np.sin(np.arange(math.ceil(8000 * seconds)))
    with wave.open(str(path), "wb") as sound:
        sound.setparams((1, 2, 8000, 0, "NONE", ""))
        sound.writeframes(samples.astype(np.int16).tobytes())
    return path


def seconds_heard(path: Path) -> float:
    """Seconds of a video's sound that are loud."""
    with av.open(str(path)) as container:
        rate = container.streams.audio[0].rate
        samples = np.concatenate([frame.to_ndarray()[0] for frame in container.decode(audio=0)])
    return float((np.abs(samples) > 0.01).sum() / rate)
