"""Merging of imported annotations with existing ones: match each to a thing, and find known ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from hilsplat.annotate.labels import Label

SAME_THING = 0.5
"""Labels of a photograph with the same text and level are the same thing if their IoU is at least this."""


@dataclass(frozen=True)
class Merged:
    """The result of an import.

    Attributes:
        views: all labels of each photograph that changes.
        added: number of labels that are new or have a changed region.
        known: number of labels that already existed.
    """

    views: dict[str, list[Label]]
    added: int
    known: int


def merged(
    known: Mapping[str, Sequence[Label]],
    files: Sequence[Mapping[str, Sequence[Label]]],
    sizes_hw: Mapping[str, tuple[int, int]],
) -> Merged:
    """Add the labels of files to those of a scene.

    A file's ids are used only together with text and level, because programs without ids number the shapes
    of every photograph from 1. Among the scene's things with the same text and level, a label is matched to
    the one that it overlaps, else to the one with its id, else to one that the photograph does not show yet;
    otherwise it is a new thing. Sizes are in px.
    """
    views = {view: list(labels) for view, labels in known.items()}
    things = {label.id: _kind(label) for labels in views.values() for label in labels}
    changed: set[str] = set()
    added = same = 0
    for found in files:
        for view, labels in found.items():
            here = views.setdefault(view, [])
            number_of: dict[int, int] = {}
            for label in sorted(labels, key=lambda label: label.level):
                parent = number_of.get(label.parent) if label.parent is not None else None
                mask = label.mask(sizes_hw[view])
                row = _row_of(label, mask, here, sizes_hw[view])
                number = here[row].id if row is not None else _number(label, here, things)
                number_of[label.id], things[number] = number, _kind(label)
                label = label.model_copy(update={"id": number, "parent": parent})
                if row is None:
                    here.append(label)
                elif np.array_equal(mask, here[row].mask(sizes_hw[view])):
                    same += 1
                    continue
                else:
                    here[row] = label
                added += 1
                changed.add(view)
    return Merged({view: views[view] for view in views if view in changed}, added, same)


def _kind(label: Label) -> tuple[str, int]:
    return label.text.casefold(), label.level


def _row_of(
    label: Label, mask: Bool[np.ndarray, "H W"], here: Sequence[Label], size_hw: tuple[int, int]
) -> int | None:
    """Return the row of a photograph's label that is the same thing; None if there is none."""
    for row, other in enumerate(here):
        if _kind(other) == _kind(label):
            region = other.mask(size_hw)
            if (mask & region).sum() >= SAME_THING * max(1, (mask | region).sum()):
                return row
    return None


def _number(label: Label, here: Sequence[Label], things: Mapping[int, tuple[str, int]]) -> int:
    """Return the id for a label that overlaps no label of its kind in the photograph."""
    taken = {other.id for other in here}
    alike = [number for number, kind in things.items() if kind == _kind(label) and number not in taken]
    if label.id in alike or label.id not in things:
        return label.id
    return min(alike, default=1 + max(things))
