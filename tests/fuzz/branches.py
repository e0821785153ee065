"""Which branches of a parser a file takes: its source is compiled with a note at each, and nothing else is changed.

Quick enough to look after every case (a tracing function is not). A branch is: either side of an `if` or a conditional
expression, a loop that goes round and one that ends, an `except`, a `case`. Compiled kernels are left as they are, but
where NUMBA_DISABLE_JIT is set.
"""

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
from dataclasses import dataclass, field

_NAME = "_branches_taken"
#: Before the names of functions and classes: these, not all but these; of what is in them, all but names after "-".
ONLY = "only"
_KERNELS = {"exact_kernel", "kernel", "inline"}


@dataclass
class Branches:
    """All branches of some modules, and which of them were taken since `forget`."""

    places: list[tuple[str, int, str]] = field(default_factory=list)  # (module, line, which)
    taken: bytearray = field(default_factory=lambda: bytearray(20_000))

    def forget(self) -> None:
        self.taken[:] = bytes(len(self.taken))

    def seen(self) -> int:
        """The branches taken, as bits of a number."""
        return int.from_bytes(self.taken[: len(self.places)], "little")

    def watch(self, modules: dict[str, tuple[str, ...]]) -> None:
        """From now on, note branches of these modules, but for the functions and classes named; before their import."""
        loaded = sorted(modules.keys() & sys.modules.keys())
        if loaded:
            raise RuntimeError(f"{loaded} must be watched before they are imported")
        sys.meta_path.insert(0, _Finder(self, modules))

    def new(self, module: str, line: int, which: str) -> int:
        self.places.append((module, line, which))
        return len(self.places) - 1


class _Finder(importlib.abc.MetaPathFinder):
    def __init__(self, branches: Branches, modules: dict[str, tuple[str, ...]]):
        self.branches, self.modules = branches, modules

    def find_spec(self, name, path, target=None):
        if name not in self.modules:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        loader = _Loader(name, spec.loader.path)
        loader.branches, loader.without = self.branches, self.modules[name]
        spec.loader = loader
        return spec


class _Loader(importlib.machinery.SourceFileLoader):
    branches: Branches
    without: tuple[str, ...]

    def get_code(self, fullname):  # not from the cache of compiled files, nor into it
        return self.source_to_code(self.get_data(self.path), self.path)

    def source_to_code(self, data, path, *, _optimize=-1):
        tree = _Noting(self.branches, self.name, self.without).visit(ast.parse(data, path))
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True, optimize=_optimize)

    def exec_module(self, module):
        setattr(module, _NAME, self.branches.taken)
        super().exec_module(module)


class _Noting(ast.NodeTransformer):
    def __init__(self, branches: Branches, module: str, without: tuple[str, ...]):
        self.branches, self.module, self.without, self.inside = branches, module, without, 0
        self.within = 0

    def _definition(self, node):
        names = {getattr(one, "id", getattr(one, "attr", "")) for one in node.decorator_list}
        compiled = names & _KERNELS and os.environ.get("NUMBA_DISABLE_JIT") != "1"
        only = self.without[:1] == (ONLY,) and not self.within
        if compiled or f"-{node.name}" in self.without:
            return node
        if node.name not in self.without if only else node.name in self.without:
            return node
        self.within += 1
        is_function = not isinstance(node, ast.ClassDef)  # what runs at import is no reading
        self.inside += is_function
        node.body = [self.visit(one) for one in node.body]
        self.inside -= is_function
        self.within -= 1
        return node

    visit_FunctionDef = visit_AsyncFunctionDef = visit_ClassDef = _definition

    def _note(self, line: int, which: str) -> ast.stmt:
        number = self.branches.new(self.module, line, which)
        return ast.parse(f"{_NAME}[{number}] = 1").body[0]

    def _two_ways(self, node, first: str, second: str):
        if not self.inside:
            return self.generic_visit(node)
        line = node.lineno
        # Before the inner ones, so that places are in the order of lines.
        begin, end = self._note(line, first), None
        endless = isinstance(node, ast.While) and isinstance(node.test, ast.Constant)
        if not endless:
            end = self._note(line, second)
        node = self.generic_visit(node)
        node.body.insert(0, begin)
        if end is not None:
            node.orelse.insert(0, end)
        return node

    def visit_If(self, node):
        return self._two_ways(node, "then", "else")

    def visit_For(self, node):
        return self._two_ways(node, "round", "end")

    def visit_While(self, node):
        return self._two_ways(node, "round", "end")

    def visit_ExceptHandler(self, node):
        if not self.inside:
            return self.generic_visit(node)
        note = self._note(node.lineno, "except")
        node = self.generic_visit(node)
        node.body.insert(0, note)
        return node

    def visit_match_case(self, node):
        note = self._note(node.body[0].lineno, "case")
        node = self.generic_visit(node)
        node.body.insert(0, note)
        return node

    def visit_IfExp(self, node):
        if not self.inside:
            return self.generic_visit(node)
        notes = [self.branches.new(self.module, node.lineno, which) for which in ("if", "else")]
        node = self.generic_visit(node)
        node.body, node.orelse = (
            ast.BoolOp(ast.Or(), [ast.parse(f"{_NAME}.__setitem__({number}, 1)", mode="eval").body, value])
            for number, value in zip(notes, (node.body, node.orelse), strict=True)
        )
        return node
