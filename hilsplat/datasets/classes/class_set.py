"""Sets of classes for labelled points."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int32


@dataclass(frozen=True)
class ClassSet:
    """K classes in a fixed order: label k of a prediction is row k - 1 here; 0 means no class.

    Attributes:
        name: such as `scannet-19`.
        source: origin of the list.
        ids: label of each class in the data set's own files.
        texts: query of each class.
    """

    name: str
    source: str
    ids: tuple[int, ...]
    texts: tuple[str, ...]

    @staticmethod
    def of(
        name: str, source: str, query_of: Mapping[int, str], ids: Iterable[int] | None = None
    ) -> "ClassSet":
        """Return the set of classes with the given ids (default: all), from a data set's queries by id."""
        chosen = tuple(query_of if ids is None else ids)
        return ClassSet(name, source, chosen, tuple(query_of[label] for label in chosen))

    def __len__(self) -> int:
        return len(self.ids)

    def labels(self, file_labels: Int[np.ndarray, " P"]) -> Int32[np.ndarray, " P"]:
        """Map the data set's point labels to 1 .. K; 0 for classes that the set lacks."""
        order = np.argsort(self.ids)
        known = np.asarray(self.ids)[order]
        place = np.minimum(np.searchsorted(known, file_labels), len(known) - 1)
        return np.where(known[place] == file_labels, order[place] + 1, 0).astype(np.int32)


def words_of(listed: str) -> list[str]:
    """Split a comma-separated list, which may have line breaks."""
    return [" ".join(word.split()) for word in listed.split(",")]
