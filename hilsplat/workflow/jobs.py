"""Types and text helpers shared by rules and plan."""

import re
from collections.abc import Collection
from typing import Any, Protocol, runtime_checkable


@runtime_checkable  # for the type checker of the tests
class Job(Protocol):
    """Wildcards of a scene's rules."""

    @property
    def dataset(self) -> str: ...
    @property
    def scene(self) -> str: ...


@runtime_checkable
class VariantJob(Job, Protocol):
    """Wildcards of a variant's rules."""

    @property
    def variant(self) -> str: ...


def any_of(names: Collection[str] | Any) -> str:
    """Return a regular expression that matches exactly these names."""
    return "|".join(sorted({re.escape(name) for name in names})) or "(?!)"


def inert(text: str) -> str:
    """Return the same JSON without `<`; Snakemake copies parameters unescaped into a script in its report."""
    return text.replace("<", "\\u003c")
