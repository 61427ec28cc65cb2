"""The three semantic levels, coarse to fine, and queries with a text for each of several levels."""

import unicodedata
from collections.abc import Collection
from enum import IntEnum

from hilsplat.base.errors import SettingsError


class Level(IntEnum):
    """Semantic level of a mask, a node or an annotation (paper, Sec. III: l = 1, 2, 3).

    The number is the paper's `l`: 1 is the whole object, 3 the finest part. Arrays store it as uint8. SAM's
    output heads are in the opposite order (subpart, part, whole).
    """

    WHOLE = 1
    PART = 2
    SUBPART = 3

    @staticmethod
    def of(level: "Level | int | str") -> "Level":
        """Return a level by number or label; raise SettingsError if there is none."""
        for known in Level:
            if level in (known, known.label):
                return known
        expected = "whole, part or subpart; queries also accept auto"
        raise SettingsError(f"level {level!r} is unknown", expected=expected)

    @property
    def label(self) -> str:
        """Name in files and tables."""
        return self.name.lower()

    @property
    def index(self) -> int:
        """Position along an axis of length L = 3: whole 0, part 1, subpart 2."""
        return int(self) - 1


LEVELS: tuple[Level, ...] = (Level.WHOLE, Level.PART, Level.SUBPART)

PATH_SEPARATOR = ">"
MAX_TEXT = 500  # maximum number of characters in a query; CLIP reads 77 tokens


def composed(text: str) -> str:
    """Return a text in composed Unicode; macOS decomposes the names of files."""
    return unicodedata.normalize("NFC", text)


def spelt(name: str, names: Collection[str]) -> str | None:
    """Return the one of `names` that equals a name, if need be in composed Unicode, or None."""
    return name if name in names else next((same for same in names if composed(same) == composed(name)), None)


def plain_text(text: str) -> str:
    """Return a text in composed Unicode and lower case with single spaces, to compare it with others."""
    return " ".join(composed(text).split()).casefold()


def path_of(text: str) -> tuple[str, ...]:
    """Return the texts of a query, coarse to fine: one text, or a path such as "bear > head > nose".

    SettingsError is raised if a text is empty or not UTF-8, or if the query is too long.
    """
    path = tuple(part.strip() for part in text.split(PATH_SEPARATOR))
    problem = "contains an empty text" if not all(path) else "is too long" if len(text) > MAX_TEXT else ""
    if problem := "is not UTF-8 text" if text != text.encode(errors="replace").decode() else problem:
        raise SettingsError(
            f"the query {problem}",
            expected=f'up to {MAX_TEXT} characters: words, or a path such as "bear > head > nose"',
            found=f"{text[:80]!r}, {len(text)} characters",
            fix="enter words on both sides of each >, shorten the query, or set the terminal to UTF-8",
        )
    return path


NONE = -1  # index that means "no such row": a root's parent, a pixel without a mask, an unassigned Gaussian
