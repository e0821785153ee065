"""The notebooks: stored outputs are complete, small and in order, and the notebooks run from top to bottom.

They run, as slow tests, with FOLDGAUSS_SMALL=1, which a cell of each reads; their stored outputs are those of the
full size. Among the quick tests, what they import and how they call it is checked.
"""

import ast
import inspect
import json
import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
SWITCH = 'SMALL = os.environ.get("FOLDGAUSS_SMALL") == "1"'
#: Size limit of a notebook, since it is part of the repository.
MOST_BYTES = 1_500_000


def code_of(notebook) -> list:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def kinds(cell) -> set[str]:
    """The kinds of a cell's outputs, independent of their number."""
    found = set()
    for output in cell["outputs"]:
        pictures = {name for name in output.get("data", {}) if name.startswith("image/")}
        found |= pictures or {output["output_type"]}
    return found


def text_of(cell) -> str:
    return "".join(cell["source"])


def test_there_are_five():
    assert [path.name[:3] for path in NOTEBOOKS] == ["01_", "02_", "03_", "04_", "05_"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_stored_outputs(path):
    """All cells executed once, in order, none with an error or a warning, and pictures among them."""
    assert path.stat().st_size < MOST_BYTES
    notebook = json.loads(path.read_text())
    cells = code_of(notebook)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert len([output for output in outputs if {"image/png", "image/jpeg"} & output.get("data", {}).keys()]) >= 4
    assert sum(SWITCH in text_of(cell) for cell in cells) == 1
    assert text_of(notebook["cells"][0]).startswith("# ")


# --- what they use exists ---------------------------------------------------------------------------------------


def _resolve(node, imported: dict):
    """The object that `name` or `name.attribute` is, where the name is imported; None for all else."""
    if isinstance(node, ast.Name):
        return imported.get(node.id)
    if isinstance(node, ast.Attribute):
        owner = _resolve(node.value, imported)
        return owner and getattr(owner, node.attr)  # an AttributeError is what is looked for
    return None


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_names_and_options_that_they_use_exist(path):
    """What they import is there, with the attributes that they use, and its calls bind."""
    transformer = pytest.importorskip("IPython.core.inputtransformer2", reason="ipykernel comes with the extra test")
    cells = code_of(json.loads(path.read_text()))
    code = "\n".join(transformer.TransformerManager().transform_cell(text_of(cell)) for cell in cells)
    nodes, imported = list(ast.walk(ast.parse(code))), {}
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            exec(ast.unparse(node), imported)
    for node in nodes:
        if isinstance(node, ast.Attribute):
            _resolve(node, imported)
        if isinstance(node, ast.Call) and not any(isinstance(argument, ast.Starred) for argument in node.args):
            options = {keyword.arg for keyword in node.keywords} - {None}
            target = _resolve(node.func, imported)
            if target is not None:
                inspect.signature(target).bind_partial(*node.args, **dict.fromkeys(options))


# --- they run ---------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
# Processor seconds at small size, nearly all of it spent in compiling: 45, 55, 11, 28 and 35.
@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    """Small, in a kernel of its own and an empty folder; every cell shows what its stored output shows."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat comes with the extra test")
    client = pytest.importorskip("nbclient", reason="nbclient comes with the extra test")
    pytest.importorskip("ipykernel", reason="ipykernel comes with the extra test")
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")
    notebook = nbformat.read(path, as_version=4)
    stored = [kinds(cell) for cell in code_of(notebook)]
    # Compiling is most of the time, and nobody looks at how fast or to which last digit: XLA need not optimise.
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
    settings = {"FOLDGAUSS_SMALL": "1", "PYTHONPATH": os.environ.get("PYTHONPATH", ""), "XLA_FLAGS": flags}
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel's own, which puts pictures into the notebook
    client.NotebookClient(
        notebook, timeout=280, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [kinds(cell) for cell in code_of(notebook)]
    assert shown == stored
    assert list(tmp_path.iterdir()) == []  # they leave nothing behind
