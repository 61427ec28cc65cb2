"""What a job of a rule is to the plan, and where its files lie."""

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

RESULTS = Path("results")
CACHE = RESULTS / ".cache"


@runtime_checkable  # the tests' type checker asks; the plan itself does not, since that is slow
class Job(Protocol):
    """The wildcards of every rule."""

    @property
    def dataset(self) -> str: ...
    @property
    def scene(self) -> str: ...


@runtime_checkable
class VariantJob(Job, Protocol):
    """The wildcards of a variant's rules."""

    @property
    def variant(self) -> str: ...


def scene_path(job: Job, *parts: str) -> str:
    """A path in a scene's folder."""
    return "/".join([str(RESULTS), job.dataset, job.scene, *parts])


def any_of(names: Collection[str] | Any) -> str:
    """Regular expression that matches exactly these names; none matches nothing."""
    return "|".join(sorted({re.escape(name) for name in names})) or "(?!)"


def inert(text: str) -> str:
    """The same JSON without `<`: Snakemake writes the parameters of jobs raw into a script of its report."""
    return text.replace("<", "\\u003c")
