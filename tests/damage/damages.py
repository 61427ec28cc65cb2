"""Hypothesis strategies for damage to the bytes of a file and the lines of YAML."""

from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

ODD_TEXTS = (
    *("", "{", "]", "\t", ": ", "- ", "&a ", "*a", "!!binary "),
    *("1e999", ".nan", "null", "yes", "\0", "é", "'"),
)


@st.composite
def byte_damages(draw) -> tuple[str, float, int]:
    """Draw a kind of damage, a position as a share of the file's length, and a number."""
    kind = draw(st.sampled_from(["flip", "cut", "zero", "more", "repeat"]))
    return kind, draw(st.floats(0, 1, exclude_max=True)), draw(st.integers(0, 255))


def damaged_bytes(content: bytes, damage: tuple[str, float, int]) -> bytes:
    """Apply damage to the content of a file."""
    kind, share, number = damage
    place = int(share * len(content))
    if kind == "cut":
        return content[:place]
    if kind == "zero":
        return content[:place] + bytes(len(content[place : place + 64])) + content[place + 64 :]
    if kind == "more":
        return content + bytes([number]) * 16
    if kind == "repeat":
        return content[:place] + content[max(0, place - 8) : place] + content[place:]
    changed = bytearray(content)
    changed[place] ^= 1 << number % 8
    return bytes(changed)


@st.composite
def damaged_texts(draw, text: str) -> str:
    """Draw a text with repeated, swapped or truncated lines and odd words in them."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.integers(0, len(lines) - 1))
        what = draw(st.integers(0, 3))
        if what == 0:
            lines.insert(place, draw(st.sampled_from(lines)))
        elif what == 1:
            other = draw(st.integers(0, len(lines) - 1))
            lines[place], lines[other] = lines[other], lines[place]
        else:
            at = draw(st.integers(0, len(lines[place])))
            rest = lines[place][at:] if what == 2 else ""
            lines[place] = lines[place][:at] + draw(st.sampled_from(ODD_TEXTS)) + rest
    return "\n".join(lines)


def flattened(found: Any) -> list[np.ndarray]:
    """Return all arrays, numbers and texts in an object, for comparison."""
    if isinstance(found, np.ndarray):
        return [found]
    if isinstance(found, Path) or callable(found) or found is None:
        return []
    if isinstance(found, dict):
        return [each for key in sorted(found, key=str) for each in flattened(found[key])]
    if isinstance(found, list | tuple):
        return [each for part in found for each in flattened(part)]
    if hasattr(found, "__dict__"):
        return flattened({key: value for key, value in vars(found).items() if not key.startswith("__")})
    return [np.asarray(found)]


def equal(one: Any, other: Any) -> bool:
    """Return whether two objects have equal content."""
    pairs = flattened(one), flattened(other)
    return len(pairs[0]) == len(pairs[1]) and all(map(np.array_equal, *pairs))
