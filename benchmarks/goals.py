"""Goals of a room: a figure made from its timings, and what it should be."""

from collections.abc import Callable
from dataclasses import dataclass

Times = dict[str, float]
"""Case -> its least time, ms; what a case is called is written in its row of the table."""


@dataclass(frozen=True)
class Goal:
    """One line of the table of goals.

    Attributes:
        what: the figure.
        unit: its unit.
        limit: what it should be at most (or at least, where `at_least`).
        figure: the figure from the times of all cases; KeyError where a case was not run.
        at_least: larger is better.
    """

    what: str
    unit: str
    limit: float
    figure: Callable[[Times], float]
    at_least: bool = False

    def row(self, times: Times) -> tuple[str, str, str, str] | None:
        """What, figure, goal and whether it is met; None where the cases were not run."""
        try:
            value = self.figure(times)
        except KeyError:
            return None
        met = value >= self.limit if self.at_least else value <= self.limit
        sign = ">=" if self.at_least else "<="
        return (
            self.what,
            f"{value:.2f} {self.unit}",
            f"{sign} {self.limit:g} {self.unit}",
            "yes" if met else "no",
        )
