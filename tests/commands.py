"""The command as the tests call it."""

import errno
import io
import math
import os
import re
import signal
import threading
import wave
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import pytest

from foldgauss import cli
from foldgauss.cli.app import application
from foldgauss.jobs import runner


def run(*arguments):
    """Exit code of the command, run in this process. Its messages must not name options that it does not have."""
    texts, words = [], [str(argument) for argument in arguments]
    show = application.err.print

    def record(*shown, **how):
        texts.extend(one for one in shown if isinstance(one, str))
        show(*shown, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(application.err, "print", record)
        with pytest.raises(SystemExit) as done:
            cli.main(words)
    assert not _find_foreign_options(words, texts)
    return done.value.code or 0


class Output(NamedTuple):
    """What a command wrote."""

    out: str
    err: str


def call(*arguments, code=0, out=(), err=()) -> Output:
    """Output of the command, which ends with this code and writes these texts, wherever its lines are broken."""
    with redirect_stdout(io.StringIO()) as shown, redirect_stderr(io.StringIO()) as told:
        assert run(*arguments) == code, told.getvalue()
    for stream, texts in ((shown, out), (told, err)):
        written = " ".join(stream.getvalue().split())
        for text in [texts] if isinstance(texts, str) else texts:
            assert text in written, written
    return Output(shown.getvalue(), told.getvalue())


def _find_foreign_options(words, texts):
    """Return options in texts that the command lacks, except those of other commands or programs that a text names."""
    known = {
        name: application.load_commands(name).get(name) for name in application.COMMANDS if name in (*words, "fit")
    }
    commands = [*known.values(), *(one for group in known.values() for one in getattr(group, "commands", {}).values())]
    own = {"--debug", "--help"} | {
        option
        for command in commands
        if command.name in words
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    named = [(text, found) for text in texts for found in re.finditer(r"(?<![\w/-])--[a-z][a-z0-9-]+", text)]
    elsewhere = re.compile(r"(\bfit\b[^.;:]*|foldgauss [a-z]+ [^:;]*|dask [^.;:]*|pip [^.;:]*)$", re.IGNORECASE)
    return [text for text, found in named if found[0] not in own and not elsewhere.search(text[: found.start()])]


@contextmanager
def interrupted_fit(step, number=signal.SIGINT):
    """A fit sends its own process this signal after a step."""
    steps = runner.fit_steps

    def stepping(*arguments, **options):
        for state, info in steps(*arguments, **options):
            if info.step == step:
                os.kill(os.getpid(), number)
            yield state, info

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "fit_steps", stepping)
        yield


@contextmanager
def full_disk(is_full):
    """There is no space left for files whose path is such."""
    replace = os.replace

    def replace_or_fail(source, target):
        if is_full(Path(target)):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.replace", replace_or_fail)
        yield


@contextmanager
def running(server):
    """A server in a thread."""
    with server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def write_tone(path: Path, seconds: float, start: float = 0.0) -> Path:
    """A .wav file of 8000 samples per second, silent before `start`; returns its path."""
    number = np.arange(math.ceil(8000 * seconds))
    samples = np.where(number < 8000 * start, 0, 20_000 * np.sin(number))
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
