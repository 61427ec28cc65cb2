"""Products of rows in registers against numpy."""

import numba
import numpy as np
import pytest

from cpusplat.lane_products import WIDE_COLUMNS, rows_of_products
from cpusplat.lanes import WIDTH


@pytest.mark.parametrize("rows", [1, 3, 8])
@pytest.mark.parametrize("wide", [False, True])
def test_products_equal_numpy_and_touch_nothing_else(rows, wide):
    add_products = rows_of_products(rows)

    @numba.njit
    def run(y, a, x, inner, begin, wide):
        add_products(y, 5, 40, a, 2, 9, x, 3, 50, inner, begin, wide)

    rng = np.random.default_rng(0)
    a, x = rng.normal(size=2 + 9 * rows).astype(np.float32), rng.normal(size=3 + 50 * 7).astype(np.float32)
    columns = WIDE_COLUMNS if wide else WIDTH
    own = np.stack([a[2 + 9 * r :][:7] for r in range(rows)]).astype(float)
    other = np.stack([x[3 + 50 * k :][:columns] for k in range(7)])
    for begin in (True, False):
        y = rng.normal(size=5 + 40 * rows).astype(np.float32)
        expected = y.copy()
        for r in range(rows):
            place = slice(5 + 40 * r, 5 + 40 * r + columns)
            expected[place] = own[r] @ other + (0 if begin else y[place])
        run(y, a, x, 7, begin, wide)
        np.testing.assert_allclose(y, expected, atol=1e-5)
