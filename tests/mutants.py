"""Mutation testing: does the quick suite notice small mistakes in the core modules?

    python -m tests.mutants [--num N] [--seed S] [--only MODULE ...] [--json FILE]

A mutant is one changed operator, comparison, constant, condition or argument. N of them (300) are drawn with a seed,
evenly over the modules of `TARGETS`, and each runs the test files of its module (`-m "not slow"`, until the first
failure). A mutant is killed where a test fails or a test takes minutes. Messages, annotations, docstrings
and definitions of types are not mutated.

With --json each mutant that is done is kept there, and the same command continues after it; remove a run from the file
to try it again. On several processors, run several commands, each with its own modules and file. Survivors are listed
with their lines: each is either equivalent, or shows what no test checks. Those that were found to be equivalent (no
test of behavior can see them) are in `REVIEWED` with the reason, by their lines.
"""

import ast
import functools
import importlib.util
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from benchmarks import _common
from benchmarks._common import console
from benchmarks._runs import Run, Runs

ROOT = Path(__file__).parent.parent
#: Equivalent mutants: for each module, the mutated line and the reason.
REVIEWED = ROOT / "benchmarks" / "records" / "mutants-equivalent.json"
#: The modules, and the test files of each, those that take the least time first.
TARGETS = {
    "distribution": [
        "test_distribution",
        "test_distribution_moments",
        "test_distribution_extremes",
        "test_distribution_conditional",
    ],
    "analysis/conditional": ["test_distribution_conditional", "test_batch_shapes", "test_interop"],
    "envelope": ["test_envelope", "test_distribution"],
    "fold": ["test_fold", "test_distribution"],
    "mixture": ["test_mixture", "test_batch_shapes", "test_interop"],
    "estimator/em/loop": ["test_em", "test_em_chunks", "test_estimator"],
    "estimator/em/m_step": ["test_em", "test_estimator"],
    "estimator/em/statistics": ["test_em", "test_em_chunks", "test_estimator"],
    "render/_cpu_kernels": ["render/test_cpu", "render/test_engines"],
    "video/models/conditioning": ["video/test_conditioning"],
    "video/models/frame_times": ["video/test_frame_times"],
    "video/fitting/adam": ["video/test_adam"],
    "io/models/compact": ["io/test_compact"],
    "video/compression/range_coder": ["io/test_range_coder"],
}
_COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
_OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult}
_OPERATORS |= {ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.And: ast.Or, ast.Or: ast.And}
#: Names of methods and functions that are exchanged.
_CALLS = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any"}
_CALLS |= {"sin": "cos", "cos": "sin", "cumsum": "cumprod", "floor": "ceil", "ceil": "floor"}


class Mutant(NamedTuple):
    """The `index`-th place of a module that can be mutated."""

    module: str
    index: int
    line: int
    change: str

    @property
    def name(self) -> str:
        return f"{self.module}:{self.line}:{self.index} {self.change}"


class _Mutator(ast.NodeTransformer):
    """Counts the places of a tree that can be mutated, and changes that of number `wanted`."""

    def __init__(self, wanted: int = -1):
        self.wanted, self.found = wanted, []

    def visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.arg | ast.JoinedStr):
            return node
        if isinstance(node, ast.AnnAssign):  # a field or a variable, whose annotation is left alone
            node.value = node.value and self.visit(node.value)
            return node
        if isinstance(node, ast.Assign) and any(getattr(one, "id", "").startswith("__") for one in node.targets):
            return node
        if isinstance(node, ast.FunctionDef):
            node.args.defaults = [self.visit(one) for one in node.args.defaults]
            node.args.kw_defaults = [one and self.visit(one) for one in node.args.kw_defaults]
            node.body = [self.visit(one) for one in node.body]
            return node
        if isinstance(node, ast.Call) and _is_message(node):
            return node
        for change, mutated in _mutations(node):
            self.found.append((node.lineno, change))
            if len(self.found) - 1 == self.wanted:
                return ast.copy_location(mutated, node)
        return self.generic_visit(node)


def _is_message(node: ast.Call) -> bool:
    name = getattr(node.func, "id", getattr(node.func, "attr", ""))
    return name in ("invalid", "warn", "TypeVar", "field", "short_repr") or name.startswith("check_")


def _mutations(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """What a node can be changed to, in words and as a node."""
    match node:
        case ast.Compare(left, [op], rest) if type(op) in _COMPARISONS:
            new = _COMPARISONS[type(op)]()
            yield f"{type(op).__name__} -> {type(new).__name__}", ast.Compare(left, [new], rest)
        case ast.BinOp(left, op, right) if type(op) in _OPERATORS:
            new = _OPERATORS[type(op)]()
            yield f"{type(op).__name__} -> {type(new).__name__}", ast.BinOp(left, new, right)
        case ast.BoolOp(op, values):
            new = _OPERATORS[type(op)]()
            yield f"{type(op).__name__} -> {type(new).__name__}", ast.BoolOp(new, values)
        case ast.UnaryOp(ast.USub() | ast.Not() | ast.Invert(), operand):
            yield f"{type(node.op).__name__} dropped", operand
        case ast.Constant(bool() as value):
            yield f"{value} -> {not value}", ast.Constant(not value)
        case ast.Constant(int() as value):
            yield f"{value} -> {value + 1}", ast.Constant(value + 1)
        case ast.Constant(float() as value):
            yield f"{value} -> {2 * value + 1}", ast.Constant(2 * value + 1)
        case ast.If(test, body, orelse):
            yield "if never", ast.If(ast.BoolOp(ast.And(), [test, ast.Constant(False)]), body, orelse)
        case ast.IfExp(test, body, orelse):
            yield "if always", body
        case ast.Call(ast.Attribute(value, name, ctx), args, keywords) if name in _CALLS:
            yield f"{name} -> {_CALLS[name]}", ast.Call(ast.Attribute(value, _CALLS[name], ctx), args, keywords)
        case ast.Call(ast.Attribute(value, "where", ctx), [test, first, second], keywords):
            yield "where swapped", ast.Call(ast.Attribute(value, "where", ctx), [test, second, first], keywords)
        case ast.AugAssign(target, op, value) if type(op) in _OPERATORS:
            new = _OPERATORS[type(op)]()
            yield f"{type(op).__name__}= -> {type(new).__name__}=", ast.AugAssign(target, new, value)


def find_mutants(module: str) -> list[Mutant]:
    mutator = _Mutator()
    mutator.visit(ast.parse((ROOT / "foldgauss" / f"{module}.py").read_text()))
    return [Mutant(module, index, *place) for index, place in enumerate(mutator.found)]


def mutate(source: str, index: int) -> str:
    """The source with its `index`-th place changed; comments are lost."""
    return ast.unparse(ast.fix_missing_locations(_Mutator(index).visit(ast.parse(source))))


def find_mutated_line(source: str, mutated: str) -> tuple[str, str]:
    """The line that differs, before and after, without comments and in one piece."""
    before = ast.unparse(ast.parse(source)).splitlines()
    return next((a.strip(), b.strip()) for a, b in zip(before, mutated.splitlines(), strict=True) if a != b)


def draw(num: int, seed: int, modules: list[str]) -> list[Mutant]:
    """`num` mutants, as many of every module as there are, one module after the other in turn."""
    shuffled = [
        random.Random(f"{seed} {name}").sample(found, len(found)) for name in modules if (found := find_mutants(name))
    ]
    in_turn = [found[k] for k in range(max(map(len, shuffled))) for found in shuffled if k < len(found)]
    return in_turn[:num]


class Checkout:
    """A copy of the checkout in a folder, and a process that runs its tests."""

    def __init__(self, folder: Path):
        self.folder = folder
        shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(".git", "site"))
        env = dict(os.environ, PYTHONPATH=str(folder), PYTHONDONTWRITEBYTECODE="1", PYTHONWARNINGS="ignore")
        env.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder.parent / "jax"))  # what one mutant compiled is there
        command = [sys.executable, "tests/forked_pytest.py"]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(command, cwd=folder, env=env, **pipes)

    def run_tests(self, modules: list[str], first: Iterable[str] = ()) -> tuple[bool, str]:
        """Whether the tests of modules pass, and the last line that they print. The tests `first` run first."""
        failed = self.folder / ".pytest_cache/v/cache/lastfailed"
        failed.parent.mkdir(parents=True, exist_ok=True)
        failed.write_text(json.dumps(dict.fromkeys(first, True)))
        files = dict.fromkeys(f"tests/{name}.py" for module in modules for name in TARGETS[module])
        arguments = ["-x", "--ff", "-q", "-n", "0", "--no-header", *files]
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()
        code, lines = json.loads(self._process.stdout.readline())
        # E: an import that fails in a conftest
        failures = [line for line in lines if line.startswith(("FAILED ", "ERROR ", "E  "))]
        if code > 0 and not failures:
            raise RuntimeError("pytest: expected passed or failed tests, got\n" + "\n".join(lines))
        return code == 0, failures[-1] if failures else f"signal {-code}"


def try_mutant(mutant: Mutant, checkout: Checkout, killers: Iterable[str] = ()) -> Run:
    path = checkout.folder / "foldgauss" / f"{mutant.module}.py"
    source, begun = path.read_text(), time.monotonic()
    mutated = mutate(source, mutant.index)
    try:
        path.write_text(mutated)
        # Python would take the bytecode of another mutant of the same length and second.
        Path(importlib.util.cache_from_source(path)).unlink(missing_ok=True)
        passed, last = checkout.run_tests([mutant.module], killers)
    finally:
        path.write_text(source)
    code, became = find_mutated_line(source, mutated)
    by = "" if passed else last.removeprefix("FAILED ")
    run = {"killed": not passed, "by": by, "code": code, "mutated": became, "module": mutant.module}
    return run | {"seconds": round(time.monotonic() - begun)}


def main(arguments: list[str] | None = None) -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--num", type=_common.whole, default=300, metavar="N", help="[300]")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="[0]")
    parser.add_argument("--only", nargs="+", choices=list(TARGETS), metavar="MODULE", help="[all]")
    options = _common.parse(parser, arguments)
    modules = list(TARGETS) if options.only is None else options.only
    mutants = draw(options.num, options.seed, modules)
    runs = Runs(options.json, {"seed": options.seed})
    # One module after the other: after a mutant of another one, the kernels of that file are compiled again.
    left = sorted(mutant for mutant in mutants if mutant.name not in runs.done)
    with tempfile.TemporaryDirectory() as parent:
        checkout = Checkout(Path(parent) / "checkout")
        passed, last = checkout.run_tests(list(dict.fromkeys(mutant.module for mutant in left))) if left else (True, "")
        if not passed:
            raise SystemExit(f"The tests fail without a change: {last}")
        for mutant in left:
            killers = {run["by"].split(" - ")[0] for run in runs.done.values() if run["module"] == mutant.module}
            runs.get(mutant.name, functools.partial(try_mutant, mutant, checkout, killers))
    show({mutant.name: runs.done[mutant.name] for mutant in mutants})


def show(rows: dict[str, Run]) -> None:
    reviewed = json.loads(REVIEWED.read_text())
    reasons = {
        name: reason
        for name, row in rows.items()
        if not row["killed"] and (reason := reviewed.get(row["module"], {}).get(row["mutated"]))
    }
    columns = "module", "mutants", "killed", "equivalent", "survived", "killed of those that are not equivalent"
    shown, figures = [], {}
    for module in [*dict.fromkeys(row["module"] for row in rows.values()), "all"]:
        own = {name: row for name, row in rows.items() if module in (row["module"], "all")}
        killed, equivalent = sum(row["killed"] for row in own.values()), len(own.keys() & reasons)
        figures |= {f"mutants_{module}": len(own), f"killed_{module}": killed, f"equivalent_{module}": equivalent}
        survived, part = len(own) - killed - equivalent, killed / max(len(own) - equivalent, 1)
        shown.append((module, len(own), killed, equivalent, survived, f"{part:.1%}"))
    _common.print_table("Mutants", columns, shown)
    for name, row in rows.items():
        if not row["killed"]:
            told = f"equivalent: {reasons[name]}" if name in reasons else "survived"
            lines = f"{name}: {told}\n  - {row['code']}\n  + {row['mutated']}"
            console.print(lines, soft_wrap=True, highlight=False, markup=False)
    _common.finish(None, figures)


if __name__ == "__main__":
    main()
