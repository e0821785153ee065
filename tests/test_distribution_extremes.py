"""The table of extremes, as asserted: `python -m benchmarks.numerics` prints the same."""

import numpy as np
import pytest

from benchmarks.numerics import BOUND, Case, cases, excess_bits

# Each compiles for seconds.
QUICK = {
    np.float32: {"degree 12", "centered"},
    np.float64: {"d 64, condition"},
}


def _parameters():
    for dtype in (np.float32, np.float64):
        for case in cases(dtype):
            marks = [] if case.name in QUICK[dtype] else [pytest.mark.slow]
            yield pytest.param(dtype, case, marks=marks, id=f"{np.dtype(dtype).name}-{case.name}")


@pytest.mark.parametrize(("dtype", "case"), [*_parameters()])
def test_extremes(dtype, case: Case):
    row = excess_bits(case, dtype)
    assert row["compared"] > 0
    assert row["slopes"] > 0
    assert row["excess"] <= BOUND
    assert row["gradient's excess"] <= BOUND
    assert row["off"] == 0
    assert row["wrong ends"] == 0
    assert row["NaN"] == 0
