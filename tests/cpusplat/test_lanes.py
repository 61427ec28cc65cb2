"""Sixteen lanes: accuracy, and comparisons with NaN; rendering tests cover the other operations."""

import numba
import numpy as np

from cpusplat.lanes import bits_ge, exp2_negative, lane_max, larger, load, reciprocal, root, smaller, store

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
def _largest(values):
    return lane_max(load(values, 16))


def test_the_largest_lane():
    values = np.random.default_rng(1).permutation(64).astype(np.float32)
    assert _largest(values) == values[16:32].max()
