"""Compiled loops of matching."""

import numpy as np

from cpusplat.compiled import compiled


@compiled
def two_nearest(products, first, best, second, column, best_of_column, second_of_column, row_of_column):
    """Update the two largest products per row and column with a block that starts at row `first`."""
    columns = products.shape[1]
    for r in range(len(products)):
        row, i = products[r], np.int32(first + r)
        largest = np.int32(-1)
        for j in range(columns):
            value, before = np.int32(row[j]), best_of_column[j]
            second_of_column[j] = max(second_of_column[j], min(before, value))
            row_of_column[j] = i if value > before else row_of_column[j]
            best_of_column[j] = max(before, value)
            largest = max(largest, value)
        below, nearest, ties = np.int32(-1), np.int32(columns), np.int32(0)
        for j in range(columns):
            value = np.int32(row[j])
            is_largest = value == largest
            below = max(below, np.int32(-1) if is_largest else value)
            nearest = min(nearest, np.int32(j) if is_largest else np.int32(columns))
            ties = np.int32(ties + (np.int32(1) if is_largest else np.int32(0)))
        best[i], second[i], column[i] = largest, largest if ties > 1 else below, nearest
