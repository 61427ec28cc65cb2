"""What both trainings share: learning rate, batches prepared ahead, learning curve."""

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

logger = logging.getLogger(__name__)

Batch = TypeVar("Batch")


@dataclass
class Curve:
    """What a training run measured on the way: rows of equal keys, the first being `step`."""

    rows: list[dict[str, float]] = field(default_factory=list)

    def add(self, **values: float | int) -> None:
        """Append a row and log it."""
        self.rows.append({name: float(f"{value:.5g}") for name, value in values.items()})
        logger.info("  ".join(f"{name} {value:g}" for name, value in self.rows[-1].items()))


def learning_rate(step: int, steps: int, peak: float, warmup: int) -> float:
    """Linear warm-up, then half a cosine down to 2 % of the peak."""
    if step < warmup:
        return peak * (step + 1) / warmup
    share = (step - warmup) / max(1, steps - warmup)
    return peak * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * share)))


def prefetched(make: Callable[[int], Batch], steps: int) -> Iterator[Batch]:
    """Yield make(0), make(1), ..., each prepared while its predecessor is worked on."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make, 0)
        for step in range(steps):
            ready = upcoming.result()
            if step + 1 < steps:
                upcoming = pool.submit(make, step + 1)
            yield ready
