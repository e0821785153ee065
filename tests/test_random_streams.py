"""Each use of random numbers has a stream of its own."""

import ast
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

import foldgauss
from foldgauss._numerics.random_streams import Stream, make_generator

PACKAGE = Path(foldgauss.__file__).parent
#: Modules whose generators come from an argument of the user: a seed or a generator, as in scipy and numpy.
FROM_THE_USER = {"estimator/em/initialization.py"}


def test_no_two_streams_seeds_or_places_draw_the_same():
    places = [(), (0,), (1,), (0, 0), (0, 1), (1, 0)]
    cases = itertools.product(Stream, places, (0, 1, 2**32, 2**64 + 1))
    first = [make_generator(stream, *place, seed=seed).integers(2**63) for stream, place, seed in cases]
    assert len(set(first)) == len(first)
    again = make_generator(Stream.BIRTH, 3, seed=5).random(4)
    np.testing.assert_array_equal(make_generator(Stream.BIRTH, 3, seed=5).random(4), again)


@pytest.mark.parametrize("stream", Stream)
def test_every_stream_has_one_use(stream):
    """Two calls may name a stream only in one module: variants, of which a fit uses one."""
    users = [path for path in PACKAGE.rglob("*.py") if re.search(rf"Stream\.{stream.name}\b", path.read_text())]
    assert len(users) == 1


def test_generators_are_made_in_one_place():
    made = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            seeded = isinstance(node, ast.Call) and node.args and isinstance(node.func, ast.Attribute)
            if seeded and node.func.attr in ("default_rng", "SeedSequence") and "seeds" not in ast.unparse(node):
                made.add(path.relative_to(PACKAGE).as_posix())
    assert made == {"_numerics/random_streams.py", *FROM_THE_USER}
