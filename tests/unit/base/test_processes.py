"""Work in processes: order, and no process where one would do."""

import os
from functools import partial

import pytest

from hilsplat.base.processes import in_processes


def square(base: int, number: int) -> tuple[int, int]:
    return base + number**2, os.getpid()


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_items(workers):
    results = list(in_processes(partial(square, 10), [(3,), (1,), (2,)], workers))
    assert [value for value, _ in results] == [19, 11, 14]
    assert all((pid == os.getpid()) == (workers == 1) for _, pid in results)


def test_a_failure_reaches_the_caller():
    with pytest.raises(TypeError, match="can only concatenate str"):
        list(in_processes(square, [(1, 2), ("1", 2)], workers=2))


def test_nothing_to_do_starts_nothing():
    assert list(in_processes(square, [], workers=4)) == []
