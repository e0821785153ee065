"""The coder of compact files: exact, close to the entropy, safe with any bytes."""

import numpy as np
import pytest
from format_reader import LOGISTIC, STRETCH, Numbers, signed_level

from foldgauss.video.compression import range_coder as coder


def columns():
    rng = np.random.default_rng(0)
    largest = 2**30 - 1
    yield "empty", np.zeros(0)
    yield "one", np.array([-7])
    yield "zeros", np.zeros(5000)
    yield "extremes", np.array([largest, -largest, 0, 1, -1] * 40)
    yield "dear", rng.integers(largest // 2, largest, 250) * rng.choice([-1, 1], 250)
    for scale in (0.3, 3, 300, 1e7):
        yield f"normal {scale}", np.clip(rng.normal(size=5000) * scale, -largest, largest)
    # A weighted sum of logits is one below a multiple of 65536 here, which is rare.
    yield "below", np.random.default_rng(1353).normal(size=40) * 3
    # The bits are nearly all ones, so that the start of the interval does not move for several bytes.
    yield "late", np.concatenate([np.zeros(20_000), np.tile([largest, 0, -1, -largest], 50)])
    # Each number is what the ones before made unlikely: dearer than it is long.
    yield "spiteful", np.concatenate([np.zeros(4000), np.tile([largest, 0, -1, -largest], 1000)])


@pytest.mark.parametrize(("name", "values"), [pytest.param(*one, id=one[0]) for one in columns()])
def test_round_trip(name, values):
    values = np.rint(values).astype(np.int32)
    plain = coder.Column.without_contexts(len(values))
    for own in (plain, known(values, 0)):
        values = np.where(own.present, values, 0)
        np.testing.assert_array_equal(coder.decode(coder.encode(values, own), own), values)


@pytest.mark.parametrize(("name", "values"), [pytest.param(*one, id=one[0]) for one in columns()])
def test_a_reader_written_from_the_page_finds_the_same_numbers(name, values):
    values = np.rint(values[:: len(values) // 1600 or 1]).astype(np.int32)  # with numbers after many zeros, too
    before = np.arange(len(values), dtype=np.int32)[:, None] - np.int32([1, 2])
    of_two_before = coder.Column.without_contexts(len(values))._replace(near=before)
    for own in (known(values[:600], 1), of_two_before):
        coded = np.where(own.present, values[: len(own.present)], 0)
        numbers, seen, found = Numbers(coder.encode(coded, own)), np.zeros(len(coded)), np.zeros_like(coded)
        for k in np.flatnonzero(own.present):
            near = [seen[i] for i in own.near[k] if i >= 0]
            predicted = signed_level((np.mean(near) * own.scale[k] - own.origin[k]) / own.step[k]) if near else 0
            found[k] = numbers.next(*own.contexts[k], predicted)
            seen[k] = (own.origin[k] + found[k] * own.step[k]) / own.scale[k]
        numbers.end()
        np.testing.assert_array_equal(found, coded)


def test_tables_of_logits_are_those_of_the_page():
    np.testing.assert_array_equal(coder.LOGISTIC, LOGISTIC)
    np.testing.assert_array_equal(coder.LOGIT, STRETCH)


def test_nothing_beyond_the_table_of_probabilities_is_read(monkeypatch):
    values, column = np.arange(1000) // 999, coder.Column.without_contexts(1000)  # the last one is not expected at all
    data = coder.encode(values, column)
    monkeypatch.setattr(coder, "LOGISTIC", np.append(coder.LOGISTIC, 0)[:-1])
    assert coder.encode(values, column) == data


def test_column_of_no_numbers_is_a_zero_byte():
    empty = coder.Column.without_contexts(0)
    assert [own.shape for own in empty] == [(0,), (0, 2), (0,), (0,), (0,), (0, 0)]
    assert coder.encode(np.zeros(0), empty) == b"\0"


def test_decoding_begins_no_number_beyond_the_last_start():
    """So that it reads none of the memory behind the bytes, however many numbers a file claims."""
    data, column = np.random.default_rng(0).integers(0, 256, 300).astype(np.uint8), coder.Column.without_contexts(400)
    interval = np.array([0, 0xFFFFFFFF, int.from_bytes(data[:4].tobytes(), "big"), 4])
    arrays = np.zeros(400, np.int32), *column, coder._initial_state(), data, interval
    assert not coder._code(*arrays, True, 4)
    assert 4 < interval[3] < 14


def test_numbers_that_are_too_large_are_damage():
    data = coder.encode(np.array([2**30]), coder.Column.without_contexts(1))
    for stop in range(4, len(data) + 1):  # shorter ones are codes of other numbers
        with pytest.raises(ValueError, match="damaged"):
            coder.decode(data[:stop], coder.Column.without_contexts(1))


def known(values, seed):
    """A column of which something is known, at random."""
    rng, num = np.random.default_rng(seed), len(values)
    near = np.minimum(rng.integers(-1, max(num, 1), (num, 3)), np.arange(num)[:, None] - 1).astype(np.int32)
    contexts = rng.integers(0, coder.CONTEXTS, (num, 2)).astype(np.uint8)
    numbers = rng.normal(size=num), np.exp(rng.normal(size=num)), np.exp(rng.normal(size=num))
    return coder.Column(rng.random(num) < 0.8, contexts, *numbers, near)


@pytest.mark.parametrize("scale", [0.2, 1.0, 5.0, 50.0])
def test_close_to_the_entropy(scale):
    """Two percent and the price of learning, at most."""
    values = np.rint(np.random.default_rng(1).laplace(size=20_000) * scale).astype(np.int32)
    counts = np.unique(values, return_counts=True)[1]
    entropy = -(counts * np.log2(counts / len(values))).sum() / 8
    assert len(coder.encode(values, coder.Column.without_contexts(len(values)))) < 1.02 * entropy + 100


def test_what_is_near_saves_bits():
    """Numbers that those before lead to expect, and contexts that tell their size."""
    rng = np.random.default_rng(3)
    scale = 4.0 ** rng.integers(0, 4, 20_000)
    values = np.rint(rng.laplace(size=20_000) * scale).astype(np.int32)
    plain = coder.Column.without_contexts(len(values))
    contexts = np.stack([np.log2(scale), 0 * scale], 1).astype(np.uint8)
    told = len(coder.encode(values, plain._replace(contexts=contexts)))
    assert told < 0.92 * len(coder.encode(values, plain))
    walk = np.rint(np.cumsum(rng.laplace(size=20_000))).astype(np.int32) // 8
    before = np.arange(-1, len(walk) - 1, dtype=np.int32)[:, None]
    near = len(coder.encode(walk, plain._replace(near=before)))
    assert near < 0.9 * len(coder.encode(walk, plain))
