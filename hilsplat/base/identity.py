"""Code identity: a digest of the definitions that a function can reach.

One mechanism decides which rules rerun, which cache entries are valid, and which compiled loops are stale. It
reads syntax trees without running the code, and follows names from definition to definition: functions,
classes and module-level statements of this package. Parts that cannot change a result are ignored:

- comments, formatting, docstrings and other bare strings;
- string literals in `raise` statements and log messages (the names in them do count);
- descriptions: text in `knob()` and `Dataset()` that is documentation only (`PROSE`);
- function annotations, except those of roots, whose arguments come from outside;
- the entries of a `Plugins` table: a stage that uses one adds it to its roots.

The data of a module, in a JSON file beside it with the same name, count like its statements.

A class that is reached counts as a whole. If anything in a module is reached, the statements that bind no
name also count, as do definitions whose decorators may register them: importing the module runs both.
"""

import contextlib
import functools
import hashlib
import json
import os
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hilsplat.base import definitions
from hilsplat.base.artifacts import atomic_path, read_memo
from hilsplat.base.definitions import PACKAGE, Import, Statement, module_of, path_of
from hilsplat.base.errors import HilsplatError

ROOT = Path(__file__).resolve().parents[1]
_PARSING = threading.Lock()
"""Lock for parsing: kernels request digests in several threads, and before Python 3.11.8 the parser fails
(SystemError) if two threads parse at once (python/cpython#106905)."""

Code = str | Callable[..., Any]
Key = tuple[str, str]
"""Module and name of a definition; an empty name stands for the statements run by importing the module."""


def code_digest(*roots: Code, root: Path = ROOT) -> str:
    """Return a digest of every definition that the roots can reach in the package, whose folder is `root`.

    Args:
        roots: functions or classes, as objects or as "hilsplat.field.field:run_field". A module name alone
            stands for all of its definitions.

    Returns:
        16 hexadecimal digits, which depend on the minor version of Python.

    Raises:
        HilsplatError: a root, or a name that the reached code imports, does not exist.
    """
    with _PARSING:
        return _digest(tuple(_place(each) for each in roots), root)


@functools.cache
def _digest(roots: tuple[str, ...], root: Path) -> str:
    """Return the digest, cached beside numba's compiled loops because computing it takes up to 0.6 s."""
    kept = root / "__pycache__" / f"identity.{sys.implementation.cache_tag}.json"
    state, key = _state(root), " ".join(roots)
    known = _known(kept, state)
    if key not in known:
        known[key] = _digest_of(roots, root)
        with contextlib.suppress(OSError, HilsplatError):  # the package may be read-only
            if _read_state(root) == state:  # no module was edited since it was imported
                with atomic_path(kept, durable=False) as temporary:
                    text = json.dumps({"state": state, "digests": _known(kept, state) | known})
                    temporary.write_text(text)
    return known[key]


def _read_state(root: Path) -> str:
    """Return a digest of each module's path, modification time and size, as Python uses to detect changes."""
    found, folders = [], [str(root)]
    for folder in folders:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.endswith((".py", ".json")):
                    stat = entry.stat()
                    found.append((entry.path, stat.st_mtime_ns, stat.st_size))
                elif entry.is_dir() and entry.name != "__pycache__":
                    folders.append(entry.path)
    return hashlib.sha256(repr(sorted(found)).encode()).hexdigest()


_state = functools.cache(_read_state)
_STATE_AT_IMPORT = _read_state(ROOT)


def is_as_imported() -> bool:
    """Return whether the package is unchanged since this module was imported, early in every command."""
    try:
        return _read_state(ROOT) == _STATE_AT_IMPORT
    except FileNotFoundError:  # a module was deleted while the state was read
        return False


def _known(kept: Path, state: str) -> dict[str, str]:
    found = read_memo(kept, dict[str, str | dict[str, str]])
    digests = found.get("digests") if found.get("state") == state else None
    return digests if isinstance(digests, dict) else {}


def _digest_of(roots: tuple[str, ...], root: Path) -> str:
    found = _reach(roots, root)
    digest = hashlib.sha256()
    for key in sorted(found):
        digest.update(":".join(key).encode())
        for text in found[key]:
            digest.update(text)
    return digest.hexdigest()[:16]


def reached(*roots: Code, root: Path = ROOT) -> list[str]:
    """Return the definitions that `code_digest` covers, as "module:name", sorted."""
    places = tuple(_place(each) for each in roots)
    return [f"{module}:{name}" for module, name in sorted(_reach(places, root)) if name]


def _place(code: Code) -> str:
    return code if isinstance(code, str) else f"{code.__module__}:{code.__qualname__.split('.')[0]}"


def _reach(roots: tuple[str, ...], root: Path) -> dict[Key, list[bytes]]:
    """Return every reachable definition, with the parts of its text that can change a result."""
    found: dict[Key, list[bytes]] = {}
    waiting: list[tuple[str, str]] = []

    def reach(module: str, name: str) -> None:
        if module in (__name__, definitions.__name__):  # how code is identified does not change results
            return
        if (module, name) not in found:
            found[module, name] = []
            waiting.append((module, name))

    def follow(module: str, chain: tuple[str, ...]) -> str:
        """Reach the definition of a dotted name in a module; return the target if the name is imported."""
        statement = module_of(module, root).bindings.get(chain[0])
        if statement is None:
            return ""
        target = statement.imports.get(chain[0])
        if target is None:
            reach(module, chain[0])
            return ""
        return follow_import(module, target, chain[1:])

    def follow_import(module: str, target: Import, rest: tuple[str, ...]) -> str:
        source, name = target.module, target.name
        if source.split(".")[0] != PACKAGE:
            return f"{source}.{name}"
        if name and path_of(f"{source}.{name}", root) is not None:
            source, name = f"{source}.{name}", ""
        while not name and rest and path_of(f"{source}.{rest[0]}", root) is not None:
            source, rest = f"{source}.{rest[0]}", rest[1:]
        if not name and rest:
            name = rest[0]
        if path_of(source, root) is None:
            raise HilsplatError(f"{module} imports {source}, which does not exist under {root}")
        if not name:  # the module itself is used as a value
            for each in module_of(source, root).bindings:
                follow(source, (each,))
        elif name in module_of(source, root).bindings:
            follow(source, (name,))
        else:
            raise HilsplatError(f"{module} uses {name!r} from {source}, which does not define it")
        return f"{source}.{name}"

    for place in roots:
        module, _, name = place.partition(":")
        if path_of(module, root) is None:
            raise HilsplatError(f"module {module} does not exist under {root}")
        known = module_of(module, root).bindings
        if name and name not in known:
            raise HilsplatError(f"{module} does not define {name!r}", expected=f"one of {', '.join(known)}")
        for each in [name] if name else known:
            follow(module, (each,))
            for chain in known[each].signature:
                follow(module, chain)
    while waiting:
        module, name = waiting.pop()
        facts = module_of(module, root)
        if name:
            reach(module, "")
            statements: Iterable[Statement] = [facts.bindings[name]]
        else:
            statements = facts.effects
            data = (path_of(module, root) or root).with_suffix(".json")
            found[module, name] += [data.read_bytes()] if data.is_file() else []
            packages = module.split(".")[:-1]
            for depth in range(len(packages)):
                reach(".".join(packages[: depth + 1]), "")
        for statement in statements:
            means = {chain[0]: follow(module, chain) for chain in statement.names}
            inner = [follow_import(module, target, rest) for target, rest in statement.inner]
            found[module, name] += [statement.text, repr((sorted(means.items()), sorted(inner))).encode()]
    return found
