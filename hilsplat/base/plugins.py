"""Tables of interchangeable components, such as readers and baselines, imported on first use."""

import importlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from typing import Any, Generic, TypeVar

Part = TypeVar("Part")


def load(reference: str) -> Any:
    """Import the object named by "module:name" or "module"."""
    module, _, name = reference.partition(":")
    imported = importlib.import_module(module)
    return getattr(imported, name) if name else imported


class Plugins(Mapping[str, Part], Generic[Part]):
    """Components by name, imported on first access.

    The digest of code (`base.code`) does not follow the entries. A stage that uses one component depends only
    on that one, and adds the component's import path in `places` to the roots of its digest.
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self.places = dict(places)

    def __getitem__(self, name: str) -> Part:
        return load(self.places[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)

    def __contains__(self, name: object) -> bool:
        return name in self.places  # without importing the component


_all_entry_points = cache(metadata.entry_points)  # it reads files of every installed package


@cache
def entry_points(group: str) -> Plugins[Any]:
    """Return the components that installed packages offer as Python entry points of a group, by name."""
    return Plugins({point.name: point.value for point in _all_entry_points().select(group=group)})
