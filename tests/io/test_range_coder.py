"""The coder of compact files: exact, close to the entropy, safe with any bytes."""

import numpy as np
import pytest

from foldgauss.io import _range_coder as coder


def columns():
    rng = np.random.default_rng(0)
    largest = 2**coder.LARGEST_BITS - 1
    yield "empty", np.zeros(0)
    yield "one", np.array([-7])
    yield "zeros", np.zeros(5000)
    yield "extremes", np.array([largest, -largest, 0, 1, -1] * 40)
    for scale in (0.3, 3, 300, 1e7):
        yield f"normal {scale}", np.clip(rng.normal(size=5000) * scale, -largest, largest)
    # Each number is what the ones before made unlikely: dearer than it is long.
    yield "spiteful", np.concatenate([np.zeros(4000), np.tile([largest, 0, -1, -largest], 1000)])


@pytest.mark.parametrize(("name", "values"), [pytest.param(*one, id=one[0]) for one in columns()])
def test_round_trip(name, values):
    values = np.rint(values).astype(np.int32)
    contexts = (np.arange(len(values)) % coder.CONTEXTS).astype(np.uint8)
    for own in (contexts, np.zeros_like(contexts)):
        np.testing.assert_array_equal(coder.decode(coder.encode(values, own), own), values)


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0, 50.0])
def test_close_to_the_entropy(scale):
    """Two percent and the price of learning, at most."""
    values = np.rint(np.random.default_rng(1).laplace(size=20_000) * scale).astype(np.int32)
    counts = np.unique(values, return_counts=True)[1]
    entropy = -(counts * np.log2(counts / len(values))).sum() / 8
    assert len(coder.encode(values, np.zeros(len(values), np.uint8))) < 1.02 * entropy + 100


def test_the_bytes_are_those_of_the_format():
    """Another implementation must come to these: docs/format.md."""
    values = np.array([0, 1, -1, 5, -300, 70_000, 0, 0, 2**30 - 1], np.int32)
    contexts = np.array([0, 0, 1, 1, 2, 2, 31, 0, 0], np.uint8)
    assert coder.encode(values, contexts).hex() == EXPECTED


EXPECTED = "7dd4e02bdb8037b363fb2bc0040df90000"


def test_any_bytes_decode_or_are_refused():
    rng = np.random.default_rng(2)
    contexts, refused = np.zeros(300, np.uint8), 0
    for _ in range(200):
        data = rng.integers(0, 256, rng.integers(0, 400), dtype=np.uint8).tobytes()
        try:
            assert np.abs(coder.decode(data, contexts).astype(np.int64)).max() < 2**coder.LARGEST_BITS
        except ValueError:
            refused += 1
    assert refused > 20
