"""A hundred hostile files for each parser at every run of the suite, and 220,000 with `pytest -m slow`.

All of it: `python -m tests.fuzz`.
"""

import ast
import json
import subprocess
import sys
from pathlib import Path
from random import Random

import hypothesis
import pytest
from hypothesis import strategies as st

from .branches import ONLY, Branches
from .models import tiny_model
from .mutate import json_changed, png_chunks, png_of
from .target import Broken, Target, judge
from .targets import TARGETS
from .worker import Run

CASES = 100
#: Kernels as Python want a process of their own.
QUICK = [name for name, target in TARGETS.items() if not target.environment]


@pytest.mark.parametrize("name", QUICK)
def test_no_file_breaks_a_parser(name, tmp_path):
    (tmp_path / "case").mkdir()
    run = Run(TARGETS[name], Branches(), tmp_path / "case", Random(0))
    run.start([])
    corpus, valid = list(run.corpus), list(run.valid)

    @hypothesis.settings(
        max_examples=CASES,
        derandomize=True,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(st.randoms(use_true_random=False))
    def case(random):
        run.one(run.mutant(random, corpus, valid), weighed=run.cases % 10 == 0)
        assert not run.crashes, run.crashes

    case()
    assert run.cases >= CASES
    assert run.past >= 0.5 * run.cases
    # All of one outcome: the mutations have gone blunt, or the parser takes everything.
    assert len(run.outcomes) >= 2, run.outcomes


def _target(parse, *errors: type[Exception]) -> Target:
    return Target("own", ".bin", lambda: [b"a"], parse, errors or (ValueError,), {}, memory=lambda size: 1 << 20)


@pytest.mark.parametrize(
    ("parse", "message"),
    [
        (lambda path: int("x"), "accidental ValueError"),
        (lambda path: {}["a"], "KeyError"),
        (lambda path: bytes(1 << 26), "memory"),
        (lambda path: __import__("warnings").warn("odd", stacklevel=1), "UserWarning"),
    ],
)
def test_the_judge_sees_what_is_wrong(tmp_path, parse, message):
    (tmp_path / "own.bin").write_bytes(b"a")
    with pytest.raises(Broken, match=message):
        judge(_target(parse), tmp_path / "own.bin", weighed=True)


def test_a_hang_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr("fuzz.target.TIME_LIMIT", 0.2)
    (tmp_path / "own.bin").write_bytes(b"a")

    def parse(path):
        while True:
            pass

    with pytest.raises(Broken, match="hang"):
        judge(_target(parse), tmp_path / "own.bin")


def test_branches_are_seen(tmp_path, monkeypatch):
    """By a module of one of each, run once."""
    source = (
        "def f(x):\n"
        "    for k in range(x):\n"
        "        if k == 1:\n"
        "            return 'a' if x > 5 else 'b'\n"
        "    try:\n"
        "        return 1 / x\n"
        "    except ZeroDivisionError:\n"
        "        return 0\n"
        "def g(x):\n"
        "    return 1 if x else 2\n"
    )
    (tmp_path / "watched_module.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    branches = Branches()
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    branches.watch({"watched_module": ("g",)})
    watched = __import__("watched_module")
    monkeypatch.delitem(sys.modules, "watched_module")

    def taken(x):
        branches.forget()
        found = watched.f(x)
        return found, {place[1:] for k, place in enumerate(branches.places) if branches.taken[k]}

    assert [place[1:] for place in branches.places] == [
        (2, "round"), (2, "end"), (3, "then"), (3, "else"), (4, "if"), (4, "else"), (7, "except"),
    ]  # fmt: skip
    assert taken(0) == (0, {(2, "end"), (7, "except")})
    assert taken(1) == (1, {(2, "round"), (3, "else"), (2, "end")})
    assert taken(6) == ("a", {(2, "round"), (3, "else"), (3, "then"), (4, "if")})


def test_changed_files_are_sealed_again():
    seed = TARGETS["masks"].seeds()[0]
    assert png_of(png_chunks(seed)) == seed
    value = {"a": [1, {"b": 2}]}
    changed = [json_changed(value, Random(k)) for k in range(50)]
    assert value == {"a": [1, {"b": 2}]}
    assert sum(json.dumps(one) != json.dumps(value) for one in changed) > 40


def test_seeds_are_small_and_of_all_kinds():
    assert tiny_model().num_gaussians == 3
    for target in TARGETS.values():
        seeds = target.seeds()
        assert len(set(seeds)) == len(seeds)
        assert max(map(len, seeds)) < 30_000, target.name


def test_names_of_functions_exist():
    """Those whose branches are left out, or alone are counted: a function may have been renamed since."""
    for target in TARGETS.values():
        for module, names in target.modules.items():
            source = Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py").read_text()
            nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
            assert {name.removeprefix("-") for name in names} <= {ONLY, *(node.name for node in nodes)}, module


@pytest.mark.slow
@pytest.mark.timeout(3 * 3600)
def test_all_of_it(tmp_path):
    root = Path(__file__).parents[2]
    words = [sys.executable, "-m", "tests.fuzz", "--json", str(tmp_path / "told.json")]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    told = json.loads((tmp_path / "told.json").read_text())
    assert sum(one["cases"] for one in told["targets"].values()) >= 200_000
    assert sum(one["past"] for one in told["targets"].values()) >= 100_000
    for module, one in told["modules"].items():
        assert one["taken"] >= 0.9 * (one["taken"] + len(one["missed"])), (module, one["missed"])
