"""A step of Adam against its formula, and arguments that the loop cannot take."""

import numpy as np
import pytest

from cpusplat import adam_step


def arrays(n: int) -> list[np.ndarray]:
    """Values, gradients and both moments."""
    rng = np.random.default_rng(0)
    return [*rng.normal(size=(2, n)).astype(np.float32), *np.zeros((2, n), np.float32)]


@pytest.mark.parametrize(
    "rates", [[0.1], (0.1,), np.array([0.1]), [0.1, 0.2, 0.3], np.array([0.1, 0.2, 0.3])]
)
def test_the_first_step_moves_each_value_by_its_rate(rates):
    # at the first step, both bias-corrected moments are those of one gradient: g / sqrt(g^2)
    values, gradients, first, second = arrays(39)
    expected = values - np.resize(rates, 39) * np.sign(gradients)
    adam_step(values, gradients, first, second, rates, 1)
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(first, 0.1 * gradients, rtol=1e-5)
    np.testing.assert_allclose(second, 0.001 * gradients**2, rtol=1e-5)


@pytest.mark.parametrize("row", range(4))
@pytest.mark.parametrize(
    "change",
    [
        lambda array: array[:16],
        lambda array: np.repeat(array, 2)[::2],
        lambda array: array.astype(np.float64),
        lambda array: array.reshape(-1, 2),
    ],
    ids=["shorter", "strided", "float64", "2D"],
)
def test_arrays_that_the_loop_would_misread_are_refused(row, change):
    given = arrays(64)
    given[row] = change(given[row])
    before = [array.copy() for array in given]
    with pytest.raises(ValueError, match="contiguous float32 arrays"):
        adam_step(*given, [0.1], 1)
    for array, same in zip(given, before, strict=True):
        np.testing.assert_array_equal(array, same)
    with pytest.raises(ValueError, match="t = 0"):
        adam_step(*arrays(64), [0.1], 0)
