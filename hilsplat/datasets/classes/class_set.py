"""Sets of classes for labelled points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Int32


@dataclass(frozen=True)
class ClassSet:
    """K classes in a stated order: class k of a prediction is row k - 1 here, 0 is none.

    Attributes:
        name: such as `scannet-19`.
        source: where the list comes from.
        ids: label of each class in the data set's own files.
        texts: query of each class.
    """

    name: str
    source: str
    ids: tuple[int, ...]
    texts: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)

    def labels(self, file_labels: Int[np.ndarray, " P"]) -> Int32[np.ndarray, " P"]:
        """Labels 1 .. K of points, from the data set's labels; 0 if the set lacks the class."""
        order = np.argsort(self.ids)
        known = np.asarray(self.ids)[order]
        place = np.minimum(np.searchsorted(known, file_labels), len(known) - 1)
        return np.where(known[place] == file_labels, order[place] + 1, 0).astype(np.int32)
