"""Tables of interchangeable components, such as readers and baselines, imported on first use."""

import importlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from typing import Any, Generic, TypeVar

from hilsplat.base.errors import HilsplatError, first_line, system_error

Part = TypeVar("Part")


def load(reference: str) -> Any:
    """Import the object named by "module:name" or "module"."""
    module, _, name = reference.partition(":")
    imported = importlib.import_module(module)
    return getattr(imported, name) if name else imported


class Plugins(Mapping[str, Part], Generic[Part]):
    """Components by name, imported on first access; HilsplatError if one is broken or is not of `kind`.

    The digest of code (`base.code`) does not follow the entries. A stage that uses one component depends only
    on that one, and adds the component's import path in `places` to the roots of its digest.
    """

    def __init__(self, group: str, places: Mapping[str, str], kind: type = object) -> None:
        self.places, self._group, self._kind = dict(places), group, kind

    def __getitem__(self, name: str) -> Part:
        place = self.places[name]
        what, fix = f"{self._group}: {name} = {place}", "correct or uninstall the package that offers it"
        try:
            part: Part = load(place)
        except Exception as error:  # a broken package can raise anything
            is_reported = system_error(error) is not None and not isinstance(error, OSError)
            if is_reported:  # such as too little memory
                raise
            raise HilsplatError(f"{what} cannot be imported: {first_line(error)}", fix=fix) from error
        is_subclass = isinstance(part, type) and issubclass(part, self._kind)
        if not (is_subclass or isinstance(part, self._kind)):
            expected = f"{self._kind.__module__}.{self._kind.__name__} (docs/extending.md)"
            raise HilsplatError(
                f"{what} has the wrong type", expected=expected, found=type(part).__name__, fix=fix
            )
        return part

    def __iter__(self) -> Iterator[str]:
        return iter(self.places)

    def __len__(self) -> int:
        return len(self.places)

    def __contains__(self, name: object) -> bool:
        return name in self.places  # without importing the component


_all_entry_points = cache(metadata.entry_points)  # it reads files of every installed package


@cache
def entry_points(group: str, kind: type = object, taken: tuple[str, ...] = ()) -> Plugins[Any]:
    """Return the components that installed packages offer as Python entry points of a group, by name.

    Args:
        kind: class or base class of the components.
        taken: names of built-in components.

    Raises:
        HilsplatError: two packages offer the same name, or one offers a name that is taken.
    """
    found = dict[str, metadata.EntryPoint]()
    for point in _all_entry_points().select(group=group):
        if point.name in taken or point.name in found:
            raise name_clash(group, point.name, *map(_package_of, (point, found.get(point.name))))
        found[point.name] = point
    return Plugins(group, {name: point.value for name, point in found.items()}, kind)


def name_clash(group: str, name: str, *packages: str) -> HilsplatError:
    return HilsplatError(
        f"{group}: {name!r} is a name in both {' and '.join(packages)}",
        fix="rename it in one of the packages, or uninstall one",
    )


def _package_of(point: metadata.EntryPoint | None) -> str:
    return point.dist.name if point and point.dist else "hilsplat"
