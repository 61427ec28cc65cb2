"""The public interface is frozen in public_interface.txt. To record an intended change:

python -m tests.unit.test_public_interface
"""

import difflib
import inspect
import re
from collections.abc import Iterator
from enum import EnumType
from pathlib import Path
from typing import get_type_hints

import hilsplat
from tests.conftest import PROJECT

FROZEN = Path(__file__).with_name("public_interface.txt")
PAGE = PROJECT / "docs/python.md"


def public_words() -> set[str]:
    """Words in the code of the page's section on objects, which decides what of a class is public."""
    section = PAGE.read_text().partition("\n## Objects\n")[2]
    return set(re.findall(r"\w+", " ".join(re.findall(r"`([^`\n]+)`", section))))


def described() -> Iterator[str]:
    """A line for each public name, and for each public attribute of a class."""
    words = public_words()
    for name in sorted(hilsplat.__all__):
        value = getattr(hilsplat, name)
        if not inspect.isclass(value):
            yield f"{name}{inspect.signature(value)}"
            continue
        yield f"class {name}({', '.join(base.__name__ for base in value.__bases__ if base is not object)})"
        hints = get_type_hints(value)
        for member in sorted(words & {*hints, *dir(value)}):
            function = getattr(value, member, None)
            if member in hints and not isinstance(value, EnumType):
                yield f"    {member}: {inspect.formatannotation(hints[member])}"
            elif callable(function):
                yield f"    {member}{inspect.signature(function)}"
            else:
                yield f"    {member}"


def lines() -> list[str]:
    """The description, with paths as Python 3.11 writes them."""
    return [line.replace("pathlib._local.", "pathlib.") for line in described()]


def test_the_public_interface_changes_only_on_purpose():
    changed = [
        line
        for line in difflib.ndiff(FROZEN.read_text().splitlines(), lines())
        if line.startswith(("- ", "+ "))
    ]
    how = "; if this is intended, describe it in CHANGELOG.md and docs/python.md, then run: python -m "
    assert not changed, "\n".join([f"the public interface has changed (-/+){how}{__name__}", *changed])


def test_the_page_names_every_public_name_and_parameter():
    page = PAGE.read_text()
    for name in hilsplat.__all__:
        value = getattr(hilsplat, name)
        assert re.search(rf"\b{name}\b", page), name
        if not inspect.isclass(value):
            (row,) = re.findall(rf"^\| `{name}\((.*?)\)` \|", page, re.M)
            parameters = inspect.signature(value).parameters.values()
            named = [str(each).partition(":")[0].partition(" =")[0].partition("=")[0] for each in parameters]
            assert re.findall(r"(?:^|, )([*\w]+)", re.sub(r"=\([^)]*\)", "", row)) == named, name


if __name__ == "__main__":
    FROZEN.write_text("\n".join(lines()) + "\n")
