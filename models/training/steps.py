"""Budget, learning rate, prefetched batches and learning curve of both trainings."""

import logging
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from typing import TypeVar

logger = logging.getLogger(__name__)

Batch = TypeVar("Batch")

DECAY_SHARE = 0.25
"""Final share of a budget, during which the learning rate decays."""


@dataclass
class Curve:
    """Learning curve: rows with equal keys; the first key is `step`."""

    rows: list[dict[str, float]] = field(default_factory=list)

    def add(self, **values: float | int) -> None:
        """Append a row and log it."""
        self.rows.append({name: float(f"{value:.5g}") for name, value in values.items()})
        logger.info("  ".join(f"{name} {value:g}" for name, value in self.rows[-1].items()))


@dataclass(frozen=True)
class Budget:
    """Duration of a training: minutes or steps, whichever ends first; 0 sets no limit.

    A number of steps is reproducible on one machine; minutes adapt the schedule to the machine's speed.
    """

    minutes: float = 0.0
    steps: int = 0

    def __post_init__(self) -> None:
        if self.minutes <= 0 and self.steps <= 0:
            raise ValueError("a training needs minutes or steps")

    def is_time_to_decay(self, step: int, minutes: float) -> bool:
        """Return whether the learning rate decay should begin."""
        by_steps = self.steps > 0 and step >= int((1 - DECAY_SHARE) * self.steps)
        return by_steps or (self.minutes > 0 and minutes >= (1 - DECAY_SHARE) * self.minutes)

    def decay_steps(self, step: int, minutes: float) -> int:
        """Return the length of a decay that begins now: the remaining steps, or at least a quarter of all.

        The shorter of two limits applies. The minimum is for a state that is already past the budget.
        """
        left = []
        if self.steps > 0:
            left.append(max(self.steps - step, round(DECAY_SHARE * self.steps)))
        if self.minutes > 0:
            pace = step / minutes if minutes > 0 else 1.0
            left.append(round(max(self.minutes - minutes, DECAY_SHARE * self.minutes) * pace))
        return max(1, min(left))


def learning_rate(step: int, peak: float, warmup: int, decay_from: int = -1, decay_steps: int = 0) -> float:
    """Return the rate of a step: linear warm-up, a constant phase, then linear decay to 1 % of the peak."""
    rate = peak * min(1.0, (step + 1) / warmup)
    if decay_from >= 0:
        rate *= max(0.01, 1 - (step - decay_from) / max(1, decay_steps))
    return rate


def prefetched(make: Callable[[int], Batch], first: int = 0) -> Generator[Batch, None, None]:
    """Yield make(first), make(first + 1), ..., each prepared while its predecessor is in use."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make, first)
        for step in count(first + 1):
            ready = upcoming.result()
            upcoming = pool.submit(make, step)
            yield ready
