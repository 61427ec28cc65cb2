"""Goals of a room: a figure computed from its timings, and its target."""

from collections.abc import Callable
from dataclasses import dataclass

Times = dict[str, float]
"""Name of a case, as in its row of the table -> its least time, ms."""


@dataclass(frozen=True)
class Goal:
    """One line of the table of goals.

    Attributes:
        what: the figure.
        unit: its unit.
        limit: the target: an upper limit, or a lower one with `at_least`.
        figure: computes the figure from the times of all cases; KeyError if a case was not run.
        at_least: larger is better.
    """

    what: str
    unit: str
    limit: float
    figure: Callable[[Times], float]
    at_least: bool = False

    def row(self, times: Times) -> tuple[str, str, str, str] | None:
        """Row of the table: what, figure, goal, and whether it is met; None if the cases were not run."""
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
