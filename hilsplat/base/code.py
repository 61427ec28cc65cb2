"""The code digest of a stage: of all modules that it imports, without comments and docstrings.

It decides which rules rerun and which cache entries are valid (docs/workflow.md). A module counts as a whole,
with its data: files of the same name beside it. Imports inside functions count, imports for type
checking do not, and neither do the packages that contain an imported module.
"""

import ast
import functools
import importlib.util
import inspect
import json
import sys
import textwrap
import threading
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from hilsplat.base.artifacts import read_memo
from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import HilsplatError
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_json

PACKAGES = ("hilsplat", "cpusplat")
"""Packages whose modules count, as do those of the packages of the roots, such as a plugin's."""

NEUTRAL = ("hilsplat.settings", "hilsplat.baselines", __name__)
"""Modules that don't count: settings, whose values are parameters of the rules, and this one."""

MEMO = Path(__file__).parent / "__pycache__" / f"code.{sys.implementation.cache_tag}.json"
"""Facts of each module; parsing all modules takes seconds."""

PARSING = threading.Lock()
"""Before Python 3.11.8, the parser fails if two threads parse at once (python/cpython#106905)."""

Code = str | Callable[..., Any]


class Facts(NamedTuple):
    """Digests of a module's files and of what counts in them, and names of modules or objects imported."""

    files: str
    digest: str
    imports: list[str]


def code_digest(*roots: Code) -> str:
    """Return a digest of the modules that the roots import, directly or not; 16 hexadecimal digits.

    Args:
        roots: functions or classes, as objects or as "hilsplat.field.field:run_field", or names of modules.

    Raises:
        HilsplatError: the module of a root does not exist.
    """
    return sha256_of_json(_digests(roots))[:16]


def modules_of(*roots: Code) -> list[str]:
    """Return the names of the modules that `code_digest` covers, sorted."""
    return sorted(_digests(roots))


def statements_of(function: Callable[..., Any]) -> str:
    """Return a function's statements as text, without its docstring and comments."""
    return "\n".join(map(ast.unparse, _definition(function).body))


def imports_of(function: Callable[..., Any]) -> list[str]:
    """Return the modules that a function's body imports, of `PACKAGES` and of the function's own package."""
    packages = {*PACKAGES, function.__module__.partition(".")[0]}
    package = sys.modules[function.__module__].__package__ or ""
    return sorted({*_followed(_imported(_definition(function), package), packages)})


def _definition(function: Callable[..., Any]) -> ast.FunctionDef:
    with PARSING:
        return _Bare().visit(ast.parse(textwrap.dedent(inspect.getsource(function)))).body[0]


def _digests(roots: tuple[Code, ...]) -> dict[str, str]:
    with PARSING:
        return _closure(tuple(r.partition(":")[0] if isinstance(r, str) else r.__module__ for r in roots))


@functools.cache
def _closure(roots: tuple[str, ...]) -> dict[str, str]:
    """Map each module that the root modules import, and these, to its digest."""
    if missing := [name for name in roots if _file(name) is None]:
        raise HilsplatError(f"there is no module {missing[0]}")
    packages = {*PACKAGES, *(name.partition(".")[0] for name in roots)}
    memo = _memo()
    facts, waiting = dict[str, Facts](), list(roots)
    while waiting:
        module = waiting.pop()
        path = _file(module)
        if path is None or module in facts or module in NEUTRAL:
            continue
        facts[module] = _facts(module, path, memo.get(module))
        waiting += _followed(facts[module].imports, packages)
    if not facts.items() <= memo.items():
        memo.update(facts)
        # The package may be read-only.
        with suppress(OSError, HilsplatError), atomic_path(MEMO, durable=False) as temporary:
            temporary.write_text(json.dumps(memo), encoding="utf-8")
    return {module: of_module.digest for module, of_module in facts.items()}


@functools.cache
def _memo() -> dict[str, Facts]:
    memo: dict[str, Facts] = read_memo(MEMO, dict[str, Facts])
    return memo


@functools.cache
def _file(module: str) -> Path | None:
    """Return the source file of a module, or None, without importing its package."""
    package, *parts = module.split(".")
    spec = importlib.util.find_spec(package)
    if spec is None:
        return None
    bases = [Path(folder, *parts) for folder in spec.submodule_search_locations or ()]
    files = [file for base in bases for file in (base / "__init__.py", base.with_suffix(".py"))]
    if not bases and not parts:
        files = [Path(spec.origin or module).with_suffix(".py")]
    return next(filter(Path.is_file, files), None)


def _facts(module: str, path: Path, known: Facts | None) -> Facts:
    files = [path, *filter(Path.is_file, map(path.with_suffix, (".json", ".tsv", ".txt")))]
    text, *data = (file.read_bytes() for file in files)
    # relative imports depend on the name, and the digest on this module
    contents = sha256_of_bytes(_own_code(), path.name.encode(), text, *data)
    if known is not None and known.files == contents:
        return known
    tree = _Bare().visit(ast.parse(text, str(path)))
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    code = json.dumps(_structure(tree)).encode()
    return Facts(contents, sha256_of_bytes(code, *data), sorted({*_imported(tree, package)}))


@functools.cache
def _own_code() -> bytes:
    return Path(__file__).read_bytes()


def _structure(node: Any) -> Any:
    """Return a syntax tree as nested lists; `ast.dump` depends on the version of Python."""
    if isinstance(node, ast.AST):
        filled = ((name, value) for name, value in ast.iter_fields(node) if value not in (None, []))
        return [type(node).__name__, {name: _structure(value) for name, value in filled}]
    if isinstance(node, list):
        return [_structure(part) for part in node]
    return [node] if isinstance(node, str) else repr(node)


def _followed(imported: Iterable[str], packages: Collection[str]) -> Iterator[str]:
    """Yield the modules of these packages among the names of imported modules and objects."""
    for name in imported:
        if name.partition(".")[0] in packages:
            yield name if _file(name) else name.rpartition(".")[0] or name


def _imported(tree: ast.AST, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield from (f"{module}.{alias.name}" for alias in node.names)


class _Bare(ast.NodeTransformer):
    """Removal of docstrings and other bare strings, and of what only type checkers read."""

    def visit_Expr(self, node: ast.Expr) -> ast.AST | None:
        is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if is_text else self.generic_visit(node)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        self.generic_visit(node)
        node.values = [part for part in node.values if getattr(part, "value", None) != ""]  # of Python 3.12
        return node

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.stmt]:
        self.generic_visit(node)
        return node.orelse if ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING") else node
