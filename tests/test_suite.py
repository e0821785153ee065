"""The suite itself: its helpers are found from whatever directory pytest is started in."""

import ast
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).parent
#: Of a package there may be others of the same name elsewhere: it imports its own by their place in it.
MODULES = [path for path in sorted(TESTS.rglob("*.py")) if not (path.parent / "__init__.py").exists()]


def imported(path: Path) -> set[str]:
    """First names of all modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            names.add(node.module.partition(".")[0])
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
    return names


def test_helpers_stand_where_pytest_finds_them():
    """Pytest puts a test's own folder and that of conftest.py on the path, and the repository's root only by chance."""
    helpers = {path.stem: path.parent for path in MODULES if not path.stem.startswith(("test_", "conftest"))}
    for path in MODULES:
        names = imported(path)
        assert "tests" not in names, path
        assert all(helpers[name] in (TESTS, path.parent) for name in names & helpers.keys()), path


def test_names_of_modules_are_unique():
    """Without packages, two modules of one name are one to Python."""
    assert max(Counter(path.stem for path in MODULES if path.stem != "conftest").values()) == 1
