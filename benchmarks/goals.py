"""Goals of a benchmark module: figures computed from its timings, with targets."""

from collections.abc import Callable
from dataclasses import dataclass

Times = dict[str, float]  # name of a case, as in its row of the table -> its minimum time, ms


@dataclass(frozen=True)
class Goal:
    """One row of the table of goals."""

    what: str  # name of the figure
    unit: str
    limit: float  # an upper limit, or a lower limit if `at_least` is set
    # computes the figure from the times of all cases; raises KeyError if a case was not run
    figure: Callable[[Times], float]
    at_least: bool = False  # whether larger is better

    def row(self, times: Times) -> tuple[str, str, str, str] | None:
        """Return the row (what, figure, goal, whether it is met), or None if the cases were not run."""
        try:
            value = self.figure(times)
        except KeyError:
            return None
        met = value >= self.limit if self.at_least else value <= self.limit
        sign = ">=" if self.at_least else "<="
        target = f"{sign} {self.limit:g} {self.unit}"
        return self.what, f"{value:.2f} {self.unit}", target, "yes" if met else "no"
