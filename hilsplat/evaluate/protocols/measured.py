"""One measured number."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """One number, without the scene and variant that it belongs to."""

    method: str
    query: str
    level: str
    metric: str
    protocol: str
    value: float
    n: int = 1
