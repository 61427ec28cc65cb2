"""What both trainings share: budget, learning rate, batches prepared ahead, learning curve."""

import logging
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from typing import TypeVar

logger = logging.getLogger(__name__)

Batch = TypeVar("Batch")

DECAY_SHARE = 0.25
"""Last part of a budget, during which the learning rate falls to almost nothing."""


@dataclass
class Curve:
    """What a training run measured on the way: rows of equal keys, the first being `step`."""

    rows: list[dict[str, float]] = field(default_factory=list)

    def add(self, **values: float | int) -> None:
        """Append a row and log it."""
        self.rows.append({name: float(f"{value:.5g}") for name, value in values.items()})
        logger.info("  ".join(f"{name} {value:g}" for name, value in self.rows[-1].items()))


@dataclass(frozen=True)
class Budget:
    """How long to train: minutes or steps, whichever ends first; 0 sets no limit.

    Steps repeat themselves on one machine; minutes fit the schedule to the machine at hand.
    """

    minutes: float = 0.0
    steps: int = 0

    def __post_init__(self) -> None:
        if self.minutes <= 0 and self.steps <= 0:
            raise ValueError("a training needs minutes or steps")

    def is_time_to_decay(self, step: int, minutes: float) -> bool:
        """Whether the learning rate should begin to fall."""
        by_steps = self.steps > 0 and step >= int((1 - DECAY_SHARE) * self.steps)
        return by_steps or (self.minutes > 0 and minutes >= (1 - DECAY_SHARE) * self.minutes)

    def decay_steps(self, step: int, minutes: float) -> int:
        """Steps over which it falls when it begins now: what is left, or a quarter, whichever is less.

        A state that is already past the budget (trained with a larger one before) decays over a quarter.
        """
        left = []
        if self.steps > 0:
            left.append(max(self.steps - step, round(DECAY_SHARE * self.steps)))
        if self.minutes > 0:
            pace = step / minutes if minutes > 0 else 1.0
            left.append(round(max(self.minutes - minutes, DECAY_SHARE * self.minutes) * pace))
        return max(1, min(left))


def learning_rate(step: int, peak: float, warmup: int, decay_from: int = -1, decay_steps: int = 0) -> float:
    """Linear warm-up, a constant stretch, then a straight line down to 1 % of the peak."""
    rate = peak * min(1.0, (step + 1) / warmup)
    if decay_from >= 0:
        rate *= max(0.01, 1 - (step - decay_from) / max(1, decay_steps))
    return rate


def prefetched(make: Callable[[int], Batch], first: int = 0) -> Generator[Batch, None, None]:
    """Yield make(first), make(first + 1), ..., each prepared while its predecessor is being used."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make, first)
        for step in count(first + 1):
            ready = upcoming.result()
            upcoming = pool.submit(make, step)
            yield ready
