"""`python -m tests.fuzz [--target NAME] [--cases N] [--seed S] [--engine guided|hypothesis] [--json FILE]`.

`guided` is a loop of our own in the manner of AFL: an input that takes a branch of the parser that none has taken is
kept and changed further (see `branches`, `worker`). `hypothesis` lets Hypothesis choose the same changes. Without
`--engine` both run, a tenth of the cases by Hypothesis. `--replay FILE --target NAME` reads one file and says what
comes of it.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from .target import Broken, Target, judge
from .targets import TARGETS

#: Cases of all targets together, without `--cases`.
CASES = 220_000
BY_HYPOTHESIS = 0.1
#: Seconds without a sign of life after which a worker is ended: longer than a case may take.
SILENCE = 300.0
#: Deaths of a worker after which a target is given up.
MOST_DEATHS = 20


@dataclass
class Result:
    """What came of a target's cases, by one engine or all."""

    cases: int = 0
    past: int = 0
    seconds: float = 0.0
    outcomes: Counter = field(default_factory=Counter)
    places: set = field(default_factory=set)
    missed: set = field(default_factory=set)
    memory: float = 0.0
    crashes: dict[str, str] = field(default_factory=dict)
    seen: bool = False

    @property
    def branches(self) -> int:
        return len(self.places)

    def add(self, told: dict) -> None:
        self.cases += told["cases"]
        self.past += told["past"]
        self.seconds += told["seconds"]
        self.outcomes += Counter(told["outcomes"])
        self.places |= set(map(tuple, told["places"]))
        missed = set(map(tuple, told["missed"]))
        self.missed = self.missed & missed if self.seen else missed
        self.seen, self.memory = True, max(self.memory, told["memory"])
        self.crashes |= told["crashes"]


def run(target: Target, cases: int, seed: int, by_hypothesis: int, folder: Path, result: Result) -> None:
    """Cases in workers, a new one whenever one dies."""
    done, deaths = 0, 0
    modules = {name: list(without) for name, without in target.modules.items()}
    environment = os.environ | {"FOLDGAUSS_FUZZ_MODULES": json.dumps(modules)} | dict(target.environment)
    while done < cases and deaths < MOST_DEATHS:
        status = folder / "status.json"
        status.unlink(missing_ok=True)
        words = [sys.executable, "-m", f"{__package__}.worker", target.name, "--cases", str(cases - done)]
        words += ["--seed", str(seed + 1000 * deaths), "--folder", str(folder)]
        words += ["--by-hypothesis", str(min(by_hypothesis, cases - done))]
        process = subprocess.Popen(words, env=environment)
        code = _watched(process, status)
        told = json.loads(status.read_text()) if status.exists() else None
        if told is not None:
            result.add(told)
            done += told["cases"]
        if code == 0:
            return
        deaths += 1
        died = target.path(folder / "case")
        if told is None and deaths > 2:
            raise SystemExit(f"{target.name}: the worker does not start")
        if told is not None and died.exists():
            kept = folder / "crashes" / f"{target.name}-died-{deaths}{target.suffix}"
            kept.parent.mkdir(exist_ok=True)
            shutil.copy(died, kept)
            why = "silence" if code is None else f"exit status {code}"
            result.crashes[f"{kept.name}: {why}"] = f"the process ended with {why}"
            result.outcomes["died"] += 1
            result.cases += 1
            done += 1


def _watched(process: subprocess.Popen, status: Path) -> int | None:
    """Its exit status; None where it was ended for its silence."""
    last, since = None, time.monotonic()
    while True:
        try:
            return process.wait(5)
        except subprocess.TimeoutExpired:
            now = status.stat().st_mtime_ns if status.exists() else None
            if now != last:
                last, since = now, time.monotonic()
            elif time.monotonic() - since > SILENCE:
                process.kill()
                process.wait()
                return None
        except BaseException:
            process.kill()
            raise


def replay(target: Target, path: Path) -> int:
    with tempfile.TemporaryDirectory() as folder:
        target.prepare(Path(folder))
        case = target.path(Path(folder))
        shutil.copy(path, case)
        try:
            print(judge(target, case, weighed=True))
        except Broken as error:
            print(f"broken: {error}")
            if error.__cause__ is not None:
                raise error.__cause__ from None
            return 1
    return 0


def table(results: dict[str, Result]) -> str:
    lines = [
        "| target | cases | past the header | accepted | documented errors | branches | memory | cases/s | crashes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, one in results.items():
        past, accepted = one.past / max(1, one.cases), one.outcomes["accepted"]
        errors = ", ".join(
            f"{kind} {n:,}" for kind, n in sorted(one.outcomes.items()) if kind not in ("accepted", "crash")
        )
        taken = one.branches - len(one.missed)
        lines.append(
            f"| {name} | {one.cases:,} | {past:.0%} | {accepted:,} | {errors} | "
            f"{taken}/{one.branches} ({taken / max(1, one.branches):.1%}) | {one.memory:.0%} | "
            f"{one.cases / max(1e-9, one.seconds):.0f} | {len(one.crashes)} |"
        )
    cases, past = sum(one.cases for one in results.values()), sum(one.past for one in results.values())
    seconds = sum(one.seconds for one in results.values())
    crashes = sum(len(one.crashes) for one in results.values())
    lines.append(
        f"| all | {cases:,} | {past / max(1, cases):.0%} | | | | | {cases / max(1e-9, seconds):.0f} | {crashes} |"
    )
    return "\n".join(lines)


def by_module(results: dict[str, Result]) -> dict[str, tuple[int, list]]:
    """(branches taken by any target, those by none) of each module."""
    places = set().union(*(one.places for one in results.values()))
    taken = set().union(*(one.places - one.missed for one in results.values()))
    return {
        module: (
            sum(place[0] == module for place in taken),
            sorted(place[1:] for place in places - taken if place[0] == module),
        )
        for module in sorted({place[0] for place in places})
    }


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split("\n\n")[1])
    parser.add_argument(
        "--target", action="append", choices=sorted(TARGETS), help="one of them; several times for more"
    )
    parser.add_argument("--cases", type=int, help=f"of each target; default: its share of {CASES:,}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=("guided", "hypothesis"), help="default: both")
    parser.add_argument("--json", type=Path, help="write what the table says, and the branches missed, to this file")
    parser.add_argument("--keep", type=Path, help="keep inputs that took new branches here, and start from those")
    parser.add_argument("--replay", type=Path, help="read this one file as --target")
    arguments = parser.parse_args()
    targets = [TARGETS[name] for name in arguments.target or TARGETS]
    if arguments.replay is not None:
        return replay(targets[0], arguments.replay)
    room = Path("/dev/shm") if Path("/dev/shm").is_dir() else None
    base = arguments.keep or Path(tempfile.mkdtemp(prefix="foldgauss-fuzz-", dir=room))
    shares = sum(target.share for target in TARGETS.values())
    results: dict[str, Result] = {}
    for target in targets:
        folder = base / target.name
        folder.mkdir(parents=True, exist_ok=True)
        result = results[target.name] = Result()
        cases = arguments.cases or round(CASES * target.share / shares)
        share = {"guided": 0.0, "hypothesis": 1.0, None: BY_HYPOTHESIS}[arguments.engine]
        run(target, cases, arguments.seed, round(share * cases), folder, result)
        print(table({target.name: result}).split("\n")[-2], flush=True)
    print(table(results))
    crashed = False
    for name, one in results.items():
        for place, text in one.crashes.items():
            crashed = True
            words = f"python -m tests.fuzz --target {name} --replay {base}/{name}/crashes/FILE"
            print(f"\n{name}: {text}\n    {place}\n    {words}")
    modules = by_module(results)
    print("\n| module | branches taken | |\n|---|---|---|")
    for module, (taken, missed) in modules.items():
        num, told = taken + len(missed), ", ".join(f"{line} {which}" for line, which in missed)
        print(f"| {module} | {taken}/{num} ({taken / max(1, num):.1%}) | not: {told} |")
    if arguments.json is not None:
        targets = {
            name: vars(one) | {"outcomes": dict(one.outcomes), "missed": sorted(one.missed), "places": one.branches}
            for name, one in results.items()
        }
        told = {module: {"taken": taken, "missed": missed} for module, (taken, missed) in modules.items()}
        arguments.json.write_text(json.dumps({"targets": targets, "modules": told}, indent=1) + "\n")
    if not crashed and arguments.keep is None:
        shutil.rmtree(base)
    return int(crashed)


if __name__ == "__main__":
    raise SystemExit(main())
