"""One target, many cases, in a process of its own: what it breaks is counted by whoever started it."""

import argparse
import contextlib
import json
import os
import resource
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from random import Random

from .branches import Branches
from .mutate import by_chance, foreign, spliced
from .target import Broken, Target, Weighed, judge

#: Of every so many cases one is weighed.
WEIGH = 50
#: Share of the cases that leave the header as it is.
PAST = 0.6
#: Inputs kept because they took a way through the parser that none had taken, beside those with a new branch.
MOST_WAYS = 200
#: Bytes beyond which a mutant is kept for a new branch only, or twice the largest seed: files of a fuzzer grow.
MOST_BYTES = 8192
#: Cases after which it is told how things are: so many are lost where the process dies.
REPORT = 200
#: Beyond what the process has when it starts: what takes more gets a MemoryError, and so is seen.
ROOM = 4 << 30


class Run:
    """Cases of one target, and what came of them."""

    def __init__(self, target: Target, branches: Branches, folder: Path, random: Random):
        self.target, self.branches, self.folder, self.random = target, branches, folder, random
        self.path = target.path(folder)
        self.outcomes: Counter[str] = Counter()
        self.crashes: dict[str, str] = {}
        self.cases = self.past = self.seen = 0
        self.corpus: list[bytes] = []  # what took a new branch or way
        self.valid: list[bytes] = []  # of these, what is accepted
        self.ways: set[int] = set()
        self.most = MOST_BYTES
        target.prepare(folder)

    def start(self, kept: list[bytes]) -> None:
        for number, data in enumerate(self.target.seeds()):
            self.path.write_bytes(data)
            with contextlib.suppress(Exception):  # what it compiles, once, is not the file's; if it breaks, `one` tells
                self.target.parse(self.path)
            self.one(data, weighed=True)
            outcome = self.last
            if outcome != "accepted":
                raise Broken(f"seed {number} of {self.target.name}: {outcome}")
            self.most = max(self.most, 2 * len(data))
            if data not in self.corpus:
                self.corpus.append(data)
                self.valid.append(data)
        for data in kept:
            self.one(data)
        self._odd_paths()
        self.cases, self.past, self.outcomes = 0, 0, Counter()

    def _odd_paths(self) -> None:
        """What is missing, and a folder in the place of a file."""
        self.path.unlink()
        for make in (lambda: None, self.path.mkdir):
            make()
            self.branches.forget()
            try:
                self.target.parse(self.path)
            except (OSError, *self.target.errors):
                pass
            self.seen |= self.branches.seen()
        self.path.rmdir()

    def one(self, data: bytes, *, weighed: bool = False) -> None:
        """One case; what breaks is kept, by what it says."""
        self.path.write_bytes(data)
        self.branches.forget()
        try:
            self.last = judge(self.target, self.path, weighed=weighed)
        except Broken as error:
            self.last = "crash"
            place = traceback.extract_tb((error.__cause__ or error).__traceback__)[-1]
            key = f"{str(error)[:60]} at {Path(place.filename).name}:{place.lineno}"
            if key not in self.crashes:
                self.crashes[key] = str(error)
                name = self.folder.parent / "crashes" / f"{self.target.name}-{len(self.crashes)}{self.target.suffix}"
                name.parent.mkdir(exist_ok=True)
                name.write_bytes(data)
                print(f"crash {name}: {error}", flush=True)
        self.outcomes[self.last] += 1
        self.cases += 1
        self._learn(data)

    def _learn(self, data: bytes) -> None:
        """Keep what took a new branch or, up to a number, a new way."""
        seen = self.branches.seen()
        new = seen & ~self.seen
        self.seen |= seen
        if new or (seen not in self.ways and len(self.ways) < MOST_WAYS and len(data) <= self.most):
            self.ways.add(seen)
            self.corpus.append(data)
            if self.last == "accepted":
                self.valid.append(data)

    def guided(self, num: int, report) -> None:
        while self.cases < num:
            self.one(self.mutant(self.random, self.corpus, self.valid), weighed=self.cases % WEIGH == 0)
            if self.cases % REPORT == 0:
                report(self)

    def mutant(self, random: Random, corpus: list[bytes], valid: list[bytes]) -> bytes:
        """A bad file: one of what is kept, changed."""
        target = self.target
        if random.random() < PAST:
            data = random.choice(valid)
            start = target.body(data)
            own = target.mutations[: target.past_header]
            self.past += 1
            if own and random.random() < 0.6:
                return random.choice(own)(data, random)
            if random.random() < 0.1:
                other = random.choice(valid)
                return data[:start] + spliced(data[start:], other[target.body(other) :], random)
            return by_chance(data, random, start)
        data = random.choice(corpus)
        how = random.random()
        if how > 0.95:
            return foreign(data, random)
        if target.mutations and how < 0.7:
            return random.choice(target.mutations)(data, random)
        return by_chance(data, random)

    def by_hypothesis(self, num: int, seed: int, report) -> None:
        import hypothesis
        from hypothesis import strategies as st

        corpus, valid = list(self.corpus), list(self.valid)  # the same ones for every case
        settings = hypothesis.settings(
            max_examples=max(1, num - self.cases), database=None, deadline=None, phases=[hypothesis.Phase.generate],
            suppress_health_check=list(hypothesis.HealthCheck),
        )  # fmt: skip

        @hypothesis.seed(seed)
        @settings
        @hypothesis.given(st.randoms(use_true_random=False))
        def case(random):
            self.one(self.mutant(random, corpus, valid), weighed=self.cases % WEIGH == 0)
            if self.cases % REPORT == 0:
                report(self)

        # It stops where it finds nothing new to draw; so it is called until the number is reached.
        while self.cases < num:
            case()

    def summary(self) -> dict:
        missed = [place for k, place in enumerate(self.branches.places) if not self.seen >> (8 * k) & 1]
        return {
            "cases": self.cases,
            "past": self.past,
            "outcomes": dict(self.outcomes),
            "places": self.branches.places,
            "missed": missed,
            "memory": Weighed.most,
            "crashes": self.crashes,
        }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("target")
    parser.add_argument("--cases", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--by-hypothesis", type=int, default=0, help="how many of the cases, the last ones")
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    branches = Branches()
    modules = json.loads(os.environ["FOLDGAUSS_FUZZ_MODULES"])
    branches.watch({name: tuple(without) for name, without in modules.items()})
    from .targets import TARGETS

    # Decoders write about every damaged file, past Python.
    with open(arguments.folder / "stderr", "ab") as told:
        os.dup2(told.fileno(), sys.stderr.fileno())
    folder = arguments.folder / "case"
    folder.mkdir(parents=True, exist_ok=True)
    run = Run(TARGETS[arguments.target], branches, folder, Random(arguments.seed))
    kept = arguments.folder / "corpus"
    kept.mkdir(exist_ok=True)
    run.start([path.read_bytes() for path in sorted(kept.iterdir())])
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if os.path.exists("/proc/self/statm") else 0
    if pages:
        limit = pages * resource.getpagesize() + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    status, begun, kept_so_far = arguments.folder / "status.json", time.monotonic(), [0]

    def report(run: Run) -> None:
        (arguments.folder / "new").write_text(json.dumps(run.summary() | {"seconds": time.monotonic() - begun}))
        os.replace(arguments.folder / "new", status)
        for number, data in enumerate(run.corpus[kept_so_far[0] :], start=kept_so_far[0]):
            (kept / f"{number:05}{run.target.suffix}").write_bytes(data)
        kept_so_far[0] = len(run.corpus)

    report(run)
    run.guided(arguments.cases - arguments.by_hypothesis, report)
    run.by_hypothesis(arguments.cases, arguments.seed, report)
    report(run)


if __name__ == "__main__":
    main()
