"""Sixteen lanes: each operation against numpy."""

import numba
import numpy as np

from cpusplat.lanes import (
    bits_ge,
    exp2_negative,
    first_bit,
    lane_max,
    lane_sum,
    larger,
    load,
    load_same,
    reciprocal,
    root,
    smaller,
    store,
    store_sums,
    transpose,
)

MANY = np.exp(np.random.default_rng(0).uniform(-20, 10, 16 * 4000)).astype(np.float32)


@numba.njit
def _over(operation, values, out):
    for at in range(0, len(values), 16):
        store(out, at, operation(load(values, at)))


def relative_error(operation, exact: np.ndarray, values: np.ndarray = MANY) -> float:
    """Largest relative error of an operation on lanes."""
    out = np.empty_like(values)
    _over(operation, values, out)
    return float(np.abs(out / exact - 1).max())


def test_functions_of_one_number_have_float32_accuracy():
    exact = MANY.astype(np.float64)
    assert relative_error(numba.njit(lambda x: reciprocal(x)), 1 / exact) < 3e-7
    assert relative_error(numba.njit(lambda x: root(x)), np.sqrt(exact)) < 1e-7
    exponents = np.linspace(-100, 0, 16 * 4000, dtype=np.float32)
    powers = np.exp2(exponents.astype(float))
    assert relative_error(numba.njit(lambda x: exp2_negative(x)), powers, exponents) < 3e-7


@numba.njit
def _compare(left, right, low, high):
    store(low, 0, smaller(load(left, 0), load(right, 0)))
    store(high, 0, larger(load(left, 0), load(right, 0)))
    return bits_ge(load(left, 0), load(right, 0))


def test_comparisons_treat_nan_as_reached():
    left, right = np.random.default_rng(1).normal(size=(2, 16)).astype(np.float32)
    low, high = np.empty((2, 16), np.float32)
    bits = _compare(left, right, low, high)
    np.testing.assert_array_equal(low, np.minimum(left, right))
    np.testing.assert_array_equal(high, np.maximum(left, right))
    assert [bits >> lane & 1 for lane in range(16)] == (left >= right).astype(int).tolist()
    left[3], right[:] = np.nan, np.inf
    assert _compare(left, right, low, high) == 1 << 3


@numba.njit
def _bits(bits):
    out = []
    while bits != 0:
        out.append(first_bit(bits))
        bits &= bits - 1
    return out


def test_bits_are_visited_from_the_lowest():
    assert _bits(0b1000_0000_0010_0101) == [0, 2, 5, 15]


@numba.njit
def _five_sums(values, out, at):
    vectors = load(values, 0), load(values, 16), load(values, 32), load(values, 48), load(values, 64)
    store_sums(out, at, vectors)


def test_sums_of_several_vectors_are_stored_at_their_indices_only():
    values = np.random.default_rng(2).normal(size=(5, 16)).astype(np.float32)
    out = np.full(16, 7.0, np.float32)
    _five_sums(values.reshape(-1), out, 2)
    np.testing.assert_allclose(out[2:7], values.sum(axis=1), rtol=1e-5, atol=1e-6)
    assert (out[:2] == 7).all() and (out[7:] == 7).all()


@numba.njit
def _reduced(values):
    row = load(values, 16)
    return lane_sum(row), lane_max(row), lane_sum(load_same(values, 18))


def test_lane_sum_lane_max_and_load_same():
    values = np.random.default_rng(1).permutation(64).astype(np.float32)
    row = values[16:32]
    assert _reduced(values) == (row.sum(), row.max(), 16 * values[18])


@numba.njit
def _transposed(source, target):
    transpose(source, 5, 20, target, 3, 18)


def test_a_block_is_transposed_between_arrays_with_different_row_lengths():
    source = np.arange(5 + 16 * 20, dtype=np.float32)
    target = np.full(3 + 16 * 18, -1, np.float32)
    _transposed(source, target)
    written = target[3:].reshape(16, 18)
    np.testing.assert_array_equal(written[:, :16], source[5:].reshape(16, 20)[:, :16].T)
    assert (written[:, 16:] == -1).all() and (target[:3] == -1).all()
