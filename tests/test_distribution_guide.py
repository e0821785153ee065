"""The guide's examples run, in order, as one program."""

import re
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[1] / "docs" / "distribution.md"


@pytest.mark.slow
def test_examples_of_the_guide_run():
    pytest.importorskip("numpyro", reason="numpyro is an optional extra")
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra").use("Agg")
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.S)
    names = {}
    exec(compile("\n".join(blocks), str(GUIDE), "exec"), names)
    assert names["select_degree"](names["x"], 4, "bic").degree == 2
    assert names["kl_divergence"](names["dist"], names["dist"]) == 0
