"""A digest of the code a stage runs, so that an edit reruns what depends on it and nothing else."""

import ast
import functools
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.errors import HilsplatError

PACKAGE = "hilsplat"
ROOT = Path(__file__).resolve().parents[1]


def code_hash(*modules: str, root: Path = ROOT) -> str:
    """Hash the given modules and everything of the package they import, directly or not.

    The imports are read from the syntax tree (also those inside functions), so imports by string
    stay invisible and are forbidden by a test. Comments, formatting and docstrings do not count.
    Digests of different Python minor versions differ.

    Args:
        modules: dotted names inside the package, such as "hilsplat.field.field".
        root: folder of the package.

    Returns:
        16 hexadecimal digits.

    Raises:
        HilsplatError: a module does not exist.
    """
    digest = hashlib.sha256()
    for module in import_closure(*modules, root=root):
        digest.update(module.encode())
        digest.update(_facts(_module_path(module, root)).dump)
    return digest.hexdigest()[:16]


def import_closure(*modules: str, root: Path = ROOT) -> list[str]:
    """Names of the modules and of all package modules they import, sorted."""
    seen: set[str] = set()
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        if module in seen:
            continue
        path = _module_path(module, root)
        if path is None:
            raise HilsplatError(f"module {module} does not exist under {root}")
        seen.add(module)
        parents = module.split(".")[:-1]
        waiting += [".".join(parents[: depth + 1]) for depth in range(len(parents))]
        waiting += _imports(module, root)
    return sorted(seen)


def _module_path(module: str, root: Path) -> Path | None:
    parts = module.split(".")
    if parts[0] != PACKAGE:
        return None
    base = root.joinpath(*parts[1:])
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def _imports(module: str, root: Path) -> tuple[str, ...]:
    """Package modules that one module's import statements name."""
    path = _module_path(module, root)
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names: list[str] = []
    for node in _facts(path).imports:
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
            continue
        base = node.module or ""
        if node.level:
            parent = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*parent, *([base] if base else [])])
        names.append(base)
        names += [f"{base}.{alias.name}" for alias in node.names]
    return tuple(name for name in names if _module_path(name, root) is not None)


@dataclass(frozen=True)
class _Facts:
    """What counts of a file.

    Attributes:
        imports: its import statements, also those inside functions.
        dump: its syntax tree without docstrings, as text.
    """

    imports: tuple[ast.Import | ast.ImportFrom, ...]
    dump: bytes


@functools.cache
def _facts(path: Path) -> _Facts:
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    imports = []
    for node in _statements(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports.append(node)
        elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                node.body = node.body[1:] or [ast.Pass()]
    return _Facts(tuple(imports), ast.dump(tree).encode())


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """The module and all statements in it; what they are made of holds no statement but in their blocks."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            waiting += getattr(node, block, ())
