"""Hostile files for each parser: forty at every run of the suite, and 20,000 with `pytest -m slow`."""

import contextlib
from random import Random

import pytest

from . import media, models, scenes, texts
from .mutate import MAGICS
from .target import judge

TARGETS = [target for module in (models, scenes, texts, media) for target in module.TARGETS]
#: Accepted mutants that are changed further, and the largest of them in bytes: files of a fuzzer grow.
MOST_KEPT = 200
MOST_BYTES = 8192


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
@pytest.mark.parametrize(
    "cases", [40, pytest.param(20_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])], ids="{} files".format
)
def test_no_file_breaks_a_parser(target, cases, tmp_path):
    target.prepare(tmp_path)
    path, random, corpus, outcomes = target.path(tmp_path), Random(0), target.seeds(), set()
    for missing in (True, False):  # a missing file, and a folder in its place
        with contextlib.suppress(OSError, *target.errors):
            target.parse(path)
        path.mkdir() if missing else path.rmdir()
    for seed in corpus:
        path.write_bytes(seed)
        target.parse(path)  # what it compiles, once, is not the file's
        assert judge(target, path, traced=True) == "accepted"
    for mutation in target.mutations:  # which are left out of mutants where they raise
        mutation(corpus[0], Random(2))
    for start in MAGICS:
        for data in (start, start + corpus[0], start + corpus[0][len(start) :]):
            path.write_bytes(data)
            outcomes.add(judge(target, path))
    for number in range(cases):
        mutant = target.mutant(random, corpus)
        path.write_bytes(mutant)
        outcome = judge(target, path, traced=number % 20 == 0)
        outcomes.add(outcome)
        if outcome == "accepted" and len(corpus) < MOST_KEPT and len(mutant) < MOST_BYTES:
            corpus.append(mutant)
    # All of one outcome: the mutations have gone blunt, or the parser takes everything.
    assert len(outcomes) >= 2, outcomes
