"""The structure of the package: no import circle, a docstring for each folder, no function that shadows a module."""

import ast
import importlib
import pkgutil
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import foldgauss

ROOT = Path(foldgauss.__file__).parent


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for path in sorted(ROOT.rglob("*.py"))}
PACKAGES = [name for name, path in SOURCES.items() if path.name == "__init__.py"]


def imported_modules(source: str, known=SOURCES) -> set[str]:
    """All modules of the package that a source imports: inside functions and under TYPE_CHECKING, too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in known else node.module)
    return found & set(known)


def test_no_import_circle():
    graph = {name: imported_modules(path.read_text()) - {name} for name, path in SOURCES.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError with the modules


@pytest.mark.parametrize("package", PACKAGES)
def test_folder_says_what_it_is_for(package):
    assert ast.get_docstring(ast.parse(SOURCES[package].read_text())), f"{package} has no docstring"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_name_shadows_a_module(package):
    loaded = importlib.import_module(package)
    for module in pkgutil.iter_modules(loaded.__path__):
        if module.name.startswith("__"):
            continue
        importlib.import_module(f"{package}.{module.name}")
        assert getattr(loaded, module.name) is importlib.import_module(f"{package}.{module.name}")
