"""Results of slow examinations of this machine, kept for later processes."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import platformdirs

from hilsplat.base.artifacts import sha256_of_json, write_text
from hilsplat.base.errors import HilsplatError


def remembered(kind: str, key: object, examine: Callable[[], str]) -> str:
    """Return the text that an examination found, which is done once for each key.

    If the user's cache folder cannot be written, each process examines again.

    Args:
        kind: name of a folder of results, which `forget` clears.
        key: JSON value that changes if the result may change, such as versions of libraries.
    """
    place = _folder(kind) / sha256_of_json(key)
    with suppress(OSError, ValueError):
        return place.read_text(encoding="utf-8")
    found = examine()
    with suppress(OSError, HilsplatError):
        write_text(place, found)
    return found


def forget(kind: str) -> None:
    """Delete the results of one kind."""
    with suppress(OSError):
        for path in _folder(kind).iterdir():
            if re.fullmatch("[0-9a-f]{64}", path.name):
                path.unlink(missing_ok=True)


def _folder(kind: str) -> Path:
    return platformdirs.user_cache_path("hilsplat") / kind
