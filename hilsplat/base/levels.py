"""The three semantic levels and their order, coarse to fine."""

from enum import IntEnum


class Level(IntEnum):
    """Semantic level of a mask, a node or an annotation (paper, Sec. III: l = 1, 2, 3).

    The number is the paper's `l`: 1 is the whole object, 3 the finest part. Arrays store it as uint8. SAM's
    output heads are in the opposite order (subpart, part, whole).
    """

    WHOLE = 1
    PART = 2
    SUBPART = 3

    @property
    def label(self) -> str:
        """Lower-case name used in files and tables."""
        return self.name.lower()

    @property
    def index(self) -> int:
        """Position along an axis of length L = 3: whole 0, part 1, subpart 2."""
        return int(self) - 1


LEVELS: tuple[Level, ...] = (Level.WHOLE, Level.PART, Level.SUBPART)

NONE = -1  # index that means "no such row": a root's parent, a pixel without a mask, an unassigned Gaussian
