"""Shared by the benchmarks: arguments, random scenes, timing in turn, tables, and the file of figures."""

import argparse
import ast
import json
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from foldgauss._runtime.machine import describe_machine as describe_machine
from foldgauss.io._atomic import atomic_path, check_writable

console = Console(width=140)

#: Range of the opacities of the random scenes.
OPACITIES = (0.05, 1.0)
#: Range of their standard deviations, in pixels: about 4.4 bounding-box tiles per splat.
SIGMAS = (1.0, 6.0)
SEED = 0
#: Seconds of rest before each timed call: XLA goes on working on threads of its own after a large result is
#: ready, which was seen to slow the next 10 ms of another engine by half.
PAUSE = 0.05
#: Calls of a task in one turn, of which the first is not counted.
BURST = 4
#: Seconds that a turn lasts at least.
TURN = 0.1


class Task(NamedTuple):
    """Something to time. `run` must return only when its results are there; `prepare` is not timed."""

    run: Callable[[], object]
    prepare: Callable[[], None] = lambda: None


class Scene(NamedTuple):
    """Random splats in pixels: what `foldgauss.render.cpu.forward` takes, and a gradient to send back."""

    size: tuple[int, int]
    leaves: tuple[np.ndarray, ...]  # mean, factor, opacity, color, background
    grad_image: np.ndarray  # (3, height, width)

    @property
    def num_splats(self) -> int:
        return len(self.leaves[0])


def random_scene(num: int, size: tuple[int, int], seed: int = SEED) -> Scene:
    """`num` splats: means and angles uniform, axes log-uniform in `SIGMAS`, opacity in `OPACITIES`."""
    rng = np.random.default_rng(seed)
    height, width = size
    sigma = np.exp(rng.uniform(*np.log(SIGMAS), (num, 2)))
    angle = rng.uniform(0, np.pi, num)
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(num, 2, 2)
    leaves = (
        rng.uniform(0, 1, (num, 2)) * [width, height],
        turn * sigma[:, None, :],
        rng.uniform(*OPACITIES, num),
        rng.uniform(0, 1, (num, 3)),
        np.zeros(3),
    )
    single = tuple(np.ascontiguousarray(leaf, np.float32) for leaf in leaves)
    return Scene(size, single, rng.normal(size=(3, height, width)).astype(np.float32))


def interleaved(tasks: dict[str, Task], rounds: int, warmup: int = 1) -> dict[str, list[float]]:
    """Seconds of each task over `rounds` rounds that run all tasks in turn, after `warmup` rounds.

    In turn, so that a noisy minute hits all of them; each round starts with another task. A task's turn is a short
    burst, at least BURST calls and TURN seconds, of which the first call is not counted: after a pause the system may
    run two threads on one core for some milliseconds, and caches are cold, which no fit or playback, where call
    follows call, would meet.
    """
    names, seconds = list(tasks), {name: [] for name in tasks}
    for round_ in range(-warmup, rounds):
        first = round_ % len(names)
        for name in names[first:] + names[:first]:
            tasks[name].prepare()
            time.sleep(PAUSE)
            calls, turn = 0, time.perf_counter()
            while calls < BURST or time.perf_counter() - turn < TURN:
                begun = time.perf_counter()
                result = tasks[name].run()
                passed = time.perf_counter() - begun
                del result  # after the clock has stopped
                if round_ >= 0 and calls > 0:
                    seconds[name].append(passed)
                calls += 1
    return seconds


def parser(doc: str) -> argparse.ArgumentParser:
    """A parser with --json; `doc` is the module's docstring, shown by --help."""
    made = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    return made


def fit_parser(doc: str, minutes: float) -> argparse.ArgumentParser:
    """A parser for fits: of which frames, with how many Gaussians, and for how long."""
    made = parser(doc)
    made.add_argument("--frames", type=frame_range, metavar="A:B", help="frames A <= i < B [all]")
    made.add_argument("--gaussians", type=whole, help="[chosen by the fit]")
    length = made.add_mutually_exclusive_group()
    length.add_argument("--minutes", type=positive, default=minutes, help=f"of each fit [{minutes:g}]")
    length.add_argument("--steps", type=whole, help="of each fit, instead of minutes")
    made.add_argument("--seed", type=int, default=0, help="[0]")
    return made


def budget(options: argparse.Namespace) -> dict[str, float]:
    """The arguments of `FitConfig` for the length that `fit_parser` asks for."""
    return {"steps": options.steps} if options.steps else {"minutes": options.minutes}


def parse(made: argparse.ArgumentParser, arguments: list[str] | None) -> argparse.Namespace:
    """Parse, and find out before the work whether the figures can be written."""
    options = made.parse_args(arguments)
    if options.json is not None:
        try:
            check_writable(options.json)
        except OSError as error:
            made.error(str(error))
    return options


def whole(text: str) -> int:
    """argparse type: a whole number >= 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number >= 1, got {text!r}")
    return int(text)


def positive(text: str) -> float:
    """argparse type: a finite number > 0."""
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number > 0, got {text!r}")
    return value


def parse_size(text: str) -> tuple[int, int]:
    """argparse type: HxW."""
    height, _, width = text.lower().partition("x")
    return whole(height), whole(width)


def frame_range(text: str) -> tuple[int | None, int | None]:
    """argparse type: A:B, of which either may be missing."""
    first, colon, last = text.partition(":")
    if not colon or any(part and not part.isdecimal() for part in (first, last)):
        raise argparse.ArgumentTypeError(f"expected A:B with whole numbers >= 0, got {text!r}")
    return (int(first) if first else None), (int(last) if last else None)


def setting(text: str) -> tuple[str, object]:
    """argparse type: NAME=VALUE, a field of `FitConfig` and a Python literal."""
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}")
    return name, ast.literal_eval(value)


def print_table(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """The first column is text, the others are numbers."""
    made = Table(title=title, title_justify="left")
    for k, column in enumerate(columns):
        made.add_column(column, justify="left" if k == 0 else "right", no_wrap=k == 0)
    for row in rows:
        made.add_row(*map(str, row))
    console.print(made)


def finish(path: Path | None, figures: dict[str, float], **more: object) -> None:
    """Print the figures and the machine, and write them to `path`, whole or not at all."""
    figures = {name: float(value) for name, value in figures.items()}
    shown = ((name, f"{value:.4g}" if abs(value) < 1000 else f"{value:,.0f}") for name, value in figures.items())
    if figures:
        print_table("Figures", ("name", "value"), shown)
    facts = describe_machine() | more.pop("facts", {})
    console.print("machine: " + ", ".join(f"{name} {value}" for name, value in facts.items()), style="dim")
    if path is not None:
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps({"figures": figures, "machine": facts, **more}, indent=2) + "\n")
