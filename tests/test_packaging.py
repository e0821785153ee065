"""What is installed with foldgauss, and what `import foldgauss` brings along."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import foldgauss

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: Whose tools are ours alone: what they make is looked at, not shipped.
WITHOUT_MINIMUMS = {"docs", "notebooks"}

#: What others ask for, and of which the newest does not go with the oldest of those others.
PARTNERS = {"pyparsing"}


def pinned(file: str) -> dict[str, Version]:
    lines = [line for line in (ROOT / file).read_text().splitlines() if line and not line.startswith("#")]
    return {name: Version(version) for name, version in (line.split("==") for line in lines)}


def required(*, without: set[str] = frozenset()) -> list[Requirement]:
    """What the project and its extras ask for by name."""
    extras = [some for extra, some in PROJECT["optional-dependencies"].items() if extra not in without]
    found = [Requirement(one) for some in (PROJECT["dependencies"], *extras) for one in some]
    return [one for one in found if one.name != "foldgauss"]


def lower_bound(requirement: Requirement) -> Version:
    (bound,) = (one.version for one in requirement.specifier if one.operator == ">=")
    return Version(bound)


def test_minimums_are_the_lower_bounds():
    bounds = {one.name: lower_bound(one) for one in required(without=WITHOUT_MINIMUMS)}
    pins = pinned("constraints-minimums.txt")
    assert {name: pins[name] for name in pins if name not in PARTNERS} == bounds
    assert not PARTNERS & {one.name for one in required()}


def test_constraints_satisfy_every_requirement():
    versions = pinned("constraints.txt")
    for one in required():
        assert one.specifier.contains(versions[one.name]), one


@pytest.mark.parametrize("file", ["constraints.txt", "constraints-minimums.txt"])
def test_constraints_are_sorted_and_named_once(file):
    names = [line.split("==")[0] for line in (ROOT / file).read_text().splitlines() if not line.startswith("#")]
    assert all(re.fullmatch("[a-z0-9]+(-[a-z0-9]+)*", name) for name in names)  # as indexes normalise them
    assert len({*names}) == len(names)


def test_the_python_of_this_run_is_one_that_is_promised():
    said = [one.rpartition(" ")[2] for one in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", one)]
    assert f">={said[0]}" == PROJECT["requires-python"]
    assert f"{sys.version_info.major}.{sys.version_info.minor}" in said


def imported_by(code: str) -> set[str]:
    """First names of all modules that are there after this code, in a fresh process with every warning an error."""
    words = [sys.executable, "-W", "error", "-c", f"{code}\nimport sys; print(*sys.modules)"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return {name.partition(".")[0] for name in done.stdout.split()}


#: Each takes a good part of the time that JAX does.
HEAVY = {"numba", "cv2", "skimage", "scipy", "sklearn", "optax", "matplotlib", "PIL", "typer", "rich", "emcee", "arviz"}


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import foldgauss", {*HEAVY, "jax", "numpy", "equinox"}),
        # SciPy is that of JAX itself.
        ("from foldgauss import *; from foldgauss.analysis import interop, plot", {*HEAVY, "numpyro"} - {"scipy"}),
        (
            "import foldgauss.video; import sys; assert 'scipy.stats' not in sys.modules",
            {"sklearn", "matplotlib", "typer", "rich", "emcee", "arviz"},
        ),
    ],
)
def test_imports_bring_nothing_heavy(code, absent):
    assert not imported_by(code) & absent


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["edit", "--halp"]])
def test_lists_of_commands_bring_no_jax(arguments):
    brings = arguments[0] == "edit"  # a command that is called is imported
    silent = "import io, sys\nown, sys.stdout = sys.stdout, io.StringIO()"  # the versions name it
    code = f"{silent}\nfrom foldgauss.cli import main\ntry: main({arguments})\nexcept SystemExit: sys.stdout = own"
    assert ("jax" in imported_by(code)) == brings


def test_tab_on_a_command_brings_no_jax():
    words = (
        "import os; os.environ |= dict(_FOLDGAUSS_COMPLETE='complete_bash', COMP_WORDS='foldgauss re', COMP_CWORD='1')"
    )
    brought = imported_by(f"{words}\nfrom foldgauss.cli import main\ntry: main()\nexcept SystemExit: pass")
    assert "render" in brought  # told, before the modules
    assert "jax" not in brought


def test_lazy_names_are_those_that_are_written_for_readers():
    """Type checkers and the API pages read the imports under TYPE_CHECKING."""
    tree = ast.parse(Path(foldgauss.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    written = {alias.name: node.module for node in block.body for alias in node.names}
    # scikit-learn: `from foldgauss import *` works without it
    needs_an_extra = {"FoldedGaussianMixture", "FoldedMixtureRegressor"}
    assert sorted({*written, "__version__"} - needs_an_extra) == foldgauss.__all__
    for name, module in written.items():
        assert getattr(foldgauss, name) is getattr(importlib.import_module(module), name)
    assert {*foldgauss.__all__} <= {*dir(foldgauss)}


def test_modules_are_attributes_and_others_are_not():
    assert foldgauss.video is importlib.import_module("foldgauss.video")
    for name in ("vidoe", "_nothing"):
        with pytest.raises(AttributeError, match=f"'foldgauss' has no attribute '{name}'"):
            getattr(foldgauss, name)


def test_a_missing_scikit_learn_is_reported_with_its_remedy(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("sklearn", "foldgauss.estimator.folded_"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(ImportError, match=r"sklearn is needed here: pip install 'foldgauss\[sklearn\]'"):
        foldgauss.estimator.__getattr__("FoldedMixtureRegressor")
