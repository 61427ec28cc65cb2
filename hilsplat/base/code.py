"""The code digest of a stage: of all modules that it imports, without comments and docstrings.

It decides which rules rerun and which cache entries are valid (docs/workflow.md). A module counts as a whole,
with the JSON file of the same name beside it. Imports inside functions count, those for type checking do not.
"""

import ast
import functools
import hashlib
import importlib.util
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from hilsplat.base.artifacts import atomic_path, read_memo
from hilsplat.base.errors import HilsplatError

PACKAGES = ("hilsplat", "cpusplat")
"""Packages whose modules count, as do those of the packages of the roots, such as a plugin's."""

NEUTRAL = ("hilsplat.settings", "hilsplat.baselines", __name__)
"""Modules that don't count: settings, whose values are parameters of the rules, and this one."""

Code = str | Callable[..., Any]


class Facts(NamedTuple):
    """Digest of a module, and dotted names that it imports, each of a module or of something in one."""

    digest: str
    imports: list[str]


def code_digest(*roots: Code) -> str:
    """Return a digest of the modules that the roots import, directly or not; 16 hexadecimal digits.

    Args:
        roots: functions or classes, as objects or as "hilsplat.field.field:run_field", or names of modules.

    Raises:
        HilsplatError: a module, or one that it imports, does not exist.
    """
    text = json.dumps([(module, _facts(module).digest) for module in modules_of(*roots)])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def modules_of(*roots: Code) -> list[str]:
    """Return the names of the modules that `code_digest` covers, sorted."""
    names = tuple(root.partition(":")[0] if isinstance(root, str) else root.__module__ for root in roots)
    return _closure(names)


@functools.cache
def _closure(roots: tuple[str, ...]) -> list[str]:
    packages = {*PACKAGES, *(name.partition(".")[0] for name in roots)}
    found, waiting = set[str](), list(roots)
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        if _file(name) is None:
            raise HilsplatError(f"there is no module {name}")
        found.add(name)
        for target in _facts(name).imports:
            if target.partition(".")[0] in packages:
                module = target if _file(target) else target.rpartition(".")[0]
                if module not in NEUTRAL:
                    waiting.append(module)
    return sorted(found)


@functools.cache
def _file(module: str) -> Path | None:
    """Return the file of a module without importing it; None if there is no such module."""
    package, *parts = module.split(".")
    root = _root(package)
    if root is None:
        return None
    base = root.joinpath(*parts)
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)


@functools.cache
def _root(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    folders = spec.submodule_search_locations if spec else None
    return Path(folders[0]) if folders else None


@functools.cache
def _facts(module: str) -> Facts:
    """Return the facts of a module, from a memo in its package if the file is unchanged (parsing is slow)."""
    path, root = _file(module), _root(module.partition(".")[0])
    assert path is not None and root is not None, module
    data = path.with_suffix(".json")
    stats = [file.stat() for file in (path, data) if file.is_file()]
    key = repr([(stat.st_mtime_ns, stat.st_size, stat.st_ino) for stat in stats])
    memo = root / "__pycache__" / f"code.{sys.implementation.cache_tag}.json"
    known = _memo(memo).get(module, {})
    if known.get("key") == key:
        return Facts(known["digest"], known["imports"])
    facts = _parsed(path.read_bytes(), data.read_bytes() if data.is_file() else b"", module, path)
    _memo(memo)[module] = {"key": key, **facts._asdict()}
    with suppress(OSError, HilsplatError), atomic_path(memo, durable=False) as temporary:  # may be read-only
        temporary.write_text(json.dumps(_memo(memo)))
    return facts


@functools.cache
def _memo(path: Path) -> dict[str, dict[str, Any]]:
    return read_memo(path, dict[str, dict[str, Any]])


def _parsed(text: bytes, data: bytes, module: str, path: Path) -> Facts:
    tree = ast.parse(text)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    imports = sorted({name for statement in _statements(tree) for name in _imported(statement, package)})
    for node in ast.walk(tree):
        for body in (getattr(node, "body", None), getattr(node, "orelse", None)):
            if isinstance(body, list):  # docstrings are statements, as are strings after an attribute
                body[:] = [statement for statement in body if not _is_string(statement)]
    return Facts(hashlib.sha256(ast.dump(tree).encode() + data).hexdigest(), imports)


def _statements(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes outside of `if TYPE_CHECKING:`."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")):
            yield node
            yield from _statements(node)


def _imported(node: ast.AST, package: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
        base = ".".join([*parents, *([node.module] if node.module else [])])
        yield from (f"{base}.{alias.name}" for alias in node.names)


def _is_string(node: ast.AST) -> bool:
    value = getattr(node, "value", None) if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
