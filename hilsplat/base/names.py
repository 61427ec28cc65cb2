"""Names of data sets, scenes, groups and variants: folders, files and commands are made from them."""

import re

MAX_NAME = 100
NAME_RULE = "letters a-z A-Z, digits, dot, dash and underscore, beginning with a letter or digit"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def name_problem(name: str) -> str | None:
    """What is wrong with a name, or None."""
    if not name:
        return "it is empty"
    if len(name) > MAX_NAME:
        return f"it is longer than {MAX_NAME} characters"
    if ".." in name:
        return 'it contains ".."'
    if NAME.fullmatch(name):
        return None
    if not re.fullmatch("[A-Za-z0-9]", name[0]):
        return f"it begins with {name[0]!r}"
    bad = sorted({letter for letter in name if not re.fullmatch("[A-Za-z0-9._-]", letter)})
    return f"it contains {', '.join(repr(letter) for letter in bad)}"
