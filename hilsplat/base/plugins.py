"""Tables of interchangeable components, such as readers and baselines, imported on first use."""

import importlib
from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar

Part = TypeVar("Part")


class Plugins(Mapping[str, Part], Generic[Part]):
    """Components by name.

    The code identity (`base.identity`) does not follow the entries: a stage that uses one component depends
    on that component alone, and adds its import path to its roots.

    Attributes:
        places: name -> "module:constant".
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self.places = dict(places)

    def __getitem__(self, name: str) -> Part:
        module, _, constant = self.places[name].partition(":")
        return getattr(importlib.import_module(module), constant)

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)

    def __contains__(self, name: object) -> bool:
        return name in self.places  # without importing the component
