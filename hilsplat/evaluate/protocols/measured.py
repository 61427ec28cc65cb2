"""One number, before the scene and the variant are known."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """One number before scene and variant are known."""

    method: str
    query: str
    level: str
    metric: str
    protocol: str
    value: float
    n: int = 1
