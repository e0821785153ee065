"""How long imports take, beside that of JAX: processes in turn, so that a noisy minute hits all of them.

    python -m benchmarks.import_time --json import_time.json

Each is a fresh process, with compiled bytecode as after an installation. A ratio is the median over rounds of seconds
by those of `import jax` in the same round: of the clock, and of the processor (user and system), which other work
disturbs less.
"""

import os
import statistics
import subprocess
import sys
import time

from benchmarks import _common

#: `foldgauss` alone is lazy; all its names are what one pays when a mixture is made.
TASKS = {
    "import jax": ["-c", "import jax"],
    "import foldgauss": ["-c", "import foldgauss"],
    "from foldgauss import *": ["-c", "from foldgauss import *"],
    "import foldgauss.video": ["-c", "import foldgauss.video"],
    "foldgauss --help": ["-m", "foldgauss", "--help"],
    "foldgauss fit --help": ["-m", "foldgauss", "fit", "--help"],
    "foldgauss re<Tab>": ["-m", "foldgauss"],
}
TYPED = {"_FOLDGAUSS_COMPLETE": "complete_bash", "COMP_WORDS": "foldgauss re", "COMP_CWORD": "1"}
FIRST = "import jax"
#: Largest ratio to the processor's time of `import jax`.
LIMIT = 1.5
#: Tasks that the limit holds for.
HELD = ("import foldgauss", "from foldgauss import *")


def seconds_of(name: str) -> tuple[float, float]:
    """Of the clock, and of the processor."""
    env = os.environ | (TYPED if "Tab" in name else {})
    env.pop("PYTHONDONTWRITEBYTECODE", None)
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, *TASKS[name]], env=env, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{name}: exit code {process.returncode}")
    return seconds, used.ru_utime + used.ru_stime


def measured(rounds: int) -> dict[str, dict[str, float]]:
    """Medians and ratios by task, after a round that is not counted."""
    names, taken = list(TASKS), {name: [] for name in TASKS}
    for round_ in range(-1, rounds):
        first = round_ % len(names)
        for name in names[first:] + names[:first]:
            seconds = seconds_of(name)
            if round_ >= 0:
                taken[name].append(seconds)
    figures = {}
    for name, pairs in taken.items():
        clock, processor = zip(*pairs, strict=True)
        first_clock, first_processor = zip(*taken[FIRST], strict=True)
        figures[name] = {
            "seconds": statistics.median(clock),
            "processor_seconds": statistics.median(processor),
            "ratio": _ratio(clock, first_clock),
            "processor_ratio": _ratio(processor, first_processor),
        }
    return figures


def _ratio(seconds: tuple[float, ...], first: tuple[float, ...]) -> float:
    return statistics.median(one / other for one, other in zip(seconds, first, strict=True))


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--rounds", type=_common.whole, default=9, help="of all tasks in turn [9]")
    options = _common.parse(parser, arguments)
    figures = measured(options.rounds)
    kinds = ("seconds", "processor_seconds", "ratio", "processor_ratio")
    rows = ((name, *(f"{of[kind]:.2f}" for kind in kinds)) for name, of in figures.items())
    _common.print_table("Imports", ("", "s", "s of processor", "by import jax", "of processor"), rows)
    kept = all(figures[name]["processor_ratio"] <= LIMIT for name in HELD)
    _common.console.print(f"{' and '.join(HELD)}: at most {LIMIT} of import jax: {'yes' if kept else 'NO'}")
    flat = {f"{name}: {key}": value for name, of in figures.items() for key, value in of.items()}
    _common.finish(options.json, flat, rounds=options.rounds, limit=LIMIT, kept=kept)


if __name__ == "__main__":
    main()
