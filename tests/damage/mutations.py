"""Random changes to files of other programs: of their bytes, of their lines, and of the values in JSON."""

import copy
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any

ODD_NUMBERS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "1e38", "99999999999999999999", "x", "", "0x1", "1,5"),
)
ODD_VALUES = (
    *(None, True, False, -1, 0, 0.5, 1e308, float("inf"), float("nan"), 2**70),
    *("", "x", "5", [], {}, [[1]]),
)


def mutated(rnd: Random, path: Path) -> bytes:
    """Return the content of a file with one to three changes of a random kind, or with one likely kind."""
    content = path.read_bytes()
    is_text = path.suffix in (".json", ".txt", ".ply") and b"\0" not in content
    for _ in range(rnd.choice((1, 1, 1, 2, 3))):
        kind = rnd.random()
        if is_text and kind < 0.8:
            lines = content.decode("utf-8", "surrogateescape").split("\n")
            content = "\n".join(mutated_lines(rnd, lines)).encode("utf-8", "surrogateescape")
        else:
            content = mutated_bytes(rnd, content)
    return content


def mutated_json(rnd: Random, value: Any) -> str:
    """Return JSON text with one to three changes of values, keys, lines or bytes."""
    value = copy.deepcopy(value)
    kind = rnd.random()
    for _ in range(rnd.choice((1, 1, 1, 2, 3))):
        if kind < 0.75:
            value = _changed(rnd, value)
    text = json.dumps(value, indent=1)
    if rnd.random() < 0.5:
        text = text.replace("Infinity", "1e400")
    if 0.75 <= kind < 0.9:  # keys that occur twice, commas that are missing
        text = "\n".join(mutated_lines(rnd, text.split("\n")))
    elif kind >= 0.9:
        text = mutated_bytes(rnd, text.encode()).decode("utf-8", "replace")
    return text


def _places(value: Any, above: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values in a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, each in items for place in ((*above, key), *_places(each, (*above, key)))]


def _changed(rnd: Random, value: Any) -> Any:
    """Change a JSON value in place at a random key or row, at each depth with the same probability."""
    places = _places(value)
    if not places:
        return rnd.choice(ODD_VALUES)
    depth = rnd.choice(sorted({len(place) for place in places}))
    *above, key = rnd.choice([place for place in places if len(place) == depth])
    holder = value
    for step in above:
        holder = holder[step]
    kind = rnd.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[_misspelt(rnd, key)] = holder.pop(key)
    elif kind == 1:
        holder.insert(key, copy.deepcopy(holder[key]))
    elif kind == 2:
        other = rnd.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        holder[key], holder[other] = holder[other], holder[key]
    elif kind == 3 or isinstance(holder[key], list | dict):
        holder[key] = copy.deepcopy(rnd.choice(ODD_VALUES))
    elif isinstance(holder[key], str):
        holder[key] = _misspelt(rnd, holder[key])
    elif isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
        number = holder[key]
        digits = float(_other_digit(rnd, repr(number)))
        same = int(digits) if isinstance(number, int) and abs(digits) < 1e6 else digits
        holder[key] = rnd.choice((same, -number, number * 1e9, number + 0.25))
    else:
        holder[key] = rnd.choice((True, False, None, "false"))
    return value


def _misspelt(rnd: Random, text: str) -> str:
    """Return a name with another case, separator, suffix, folder or letter."""
    place = rnd.randrange(len(text) + 1)
    return rnd.choice(
        (
            *(text.upper(), text.title(), text.replace("/", "\\"), text.replace("_", "-"), f"./{text}"),
            *(f"a/{text}", f"../{text}", f"/{text}", f"C:\\{text}", text.rpartition(".")[0] or text),
            *(text[:place] + text[place + 1 :], text[:place] + rnd.choice("aé _.9") + text[place:]),
            *(text.rpartition("/")[2], text.replace(".png", ".JPG"), f" {text} "),
        )
    )


def _other_digit(rnd: Random, text: str) -> str:
    """Return a number in which one digit differs; its first digit stays above 0."""
    digits = [place for place, letter in enumerate(text.partition("e")[0]) if letter.isdigit()]
    if not digits:
        return text
    place = rnd.choice(digits)
    return text[:place] + str(rnd.randint(1, 9)) + text[place + 1 :]


def mutated_lines(rnd: Random, lines: list[str], odd: Sequence[str] = ODD_NUMBERS) -> list[str]:
    """Drop, repeat, swap, join or change lines; words are replaced by odd ones."""
    lines = list(lines)
    place, other = rnd.randrange(len(lines)), rnd.randrange(len(lines))
    kind = rnd.randrange(10)
    if kind == 0:
        del lines[place]
    elif kind == 1:
        lines.insert(other, lines[place])
    elif kind == 2:
        lines[place], lines[other] = lines[other], lines[place]
    elif kind == 3:
        lines.insert(place, rnd.choice(("", "# x", " ", "\r")))
    else:
        words = lines[place].split(" ")
        word, second = rnd.randrange(len(words)), rnd.randrange(len(words))
        if kind == 4:
            del words[word]
        elif kind == 5:
            words.insert(second, words[word])
        elif kind == 6:
            words[word], words[second] = words[second], words[word]
        elif kind == 7:
            words[word] = rnd.choice(odd)
        elif kind == 8:
            words[word] = _other_digit(rnd, words[word])
        else:
            words[word] = _misspelt(rnd, words[word])
        lines[place] = " ".join(words)
    return lines


def mutated_bytes(rnd: Random, content: bytes) -> bytes:
    """Flip, cut, clear, add, repeat, remove or swap bytes, or write an odd number over them."""
    place, other = sorted((rnd.randrange(len(content) + 1), rnd.randrange(len(content) + 1)))
    kind, length = rnd.randrange(9), rnd.choice((1, 2, 4, 8, 24, 64))
    head, tail = content[:place], content[place:]
    if kind <= 1:
        changed = bytearray(content or b"\0")
        changed[min(place, len(changed) - 1)] ^= 1 << rnd.randrange(8)
        return bytes(changed)
    if kind == 2:
        return head
    if kind == 3:
        return head + bytes(len(tail[:length])) + tail[length:]
    if kind == 4:
        return head + rnd.randbytes(length) + tail
    if kind == 5:
        return head + tail[:length] + tail
    if kind == 6:
        return head + tail[length:]
    if kind == 7:
        second = content[other : other + length]
        between, after = content[place + len(second) : other], content[other + len(second) :]
        return head + second + between + tail[: len(second)] + after
    number = rnd.choice((float("nan"), float("inf"), -1.0, 0.0, 1e30))
    odd = rnd.choice((struct.pack("<f", number), struct.pack("<d", number), b"\xff" * 8, b"\xff" * 4))
    place -= place % 4
    return content[:place] + odd[: len(content) - place] + content[place + len(odd) :]
