"""The identity of code: a digest over the definitions that a function can reach.

One mechanism decides which rules rerun, which cache entries are valid, and which compiled loops are stale. It
reads syntax trees, never runs the code, and follows names from definition to definition: functions, classes
and module-level statements of this package. What cannot change a result does not count:

- comments, formatting, docstrings and other bare strings;
- the words of `raise` statements and of log messages (the names in them do count);
- descriptions: words in `knob()` and `Dataset()` that only people read (`PROSE`);
- annotations of functions, except for roots, whose arguments come from outside;
- the entries of a `Plugins` table: a stage that uses one names it as a further root.

A reached class counts as a whole. If anything in a module is reached, its statements that bind no name count
too, and so do definitions whose decorators may register them, because importing the module runs both.
"""

import ast
import contextlib
import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import parse_json, write_json
from hilsplat.base.errors import HilsplatError

PACKAGE = "hilsplat"
ROOT = Path(__file__).resolve().parents[1]
_PARSING = threading.Lock()
"""Kernels ask for digests from several threads, and before 3.11.8 Python's parser fails (SystemError) if two
threads parse at once (python/cpython#106905)."""

NEUTRAL_DECORATORS = frozenset(
    [
        "cache",
        "cached_property",
        "compiled",
        "contextmanager",
        "dataclass",
        "lru_cache",
        "no_type_check",
        "overload",
    ]
)
"""Decorators that register nothing: what they decorate counts only if it is reached."""

PROSE = {
    "knob": ("unit", "origin"),
    "Dataset": ("licence", "terms", "citation", "layout"),
    "Segments": ("licence", "terms", "citation", "layout"),
}
"""Called name -> keywords that only people read."""

LOG_METHODS = frozenset({"debug", "info", "warning", "error", "exception"})

Code = str | Callable[..., Any]
Key = tuple[str, str]
"""Module and name of a definition; an empty name is what importing the module runs."""


def code_digest(*roots: Code, root: Path = ROOT) -> str:
    """Digest every definition of the package that the roots can reach.

    Args:
        roots: functions or classes, as objects or as "hilsplat.field.field:run_field". The name of a module
            alone means all of its definitions.
        root: folder of the package.

    Returns:
        16 hexadecimal digits. Digests of different Python minor versions differ.

    Raises:
        HilsplatError: a root, or a name that reached code imports, does not exist.
    """
    with _PARSING:
        return _digest(tuple(_place(each) for each in roots), root)


@functools.cache
def _digest(roots: tuple[str, ...], root: Path) -> str:
    """The digest, kept beside numba's compiled loops: finding it takes up to 0.6 s, as long as a table."""
    kept = root / "__pycache__" / f"identity.{sys.implementation.cache_tag}.json"
    state, key = _state(root), " ".join(roots)
    known = _known(kept, state)
    if key not in known:
        known[key] = _digest_of(roots, root)
        with contextlib.suppress(OSError, HilsplatError):  # a package that we may not write to
            write_json(kept, {"state": state, "digests": _known(kept, state) | known})
    return known[key]


@functools.cache
def _state(root: Path) -> str:
    """Digest of the names, times and sizes of all modules, by which Python too tells that one has changed."""
    digest = hashlib.sha256()
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(set(folders) - {"__pycache__"})
        for name in sorted(files):
            if name.endswith(".py"):
                place = Path(folder, name)
                found = place.stat()
                about = f"{place.relative_to(root)} {found.st_mtime_ns} {found.st_size}\n"
                digest.update(about.encode())
    return digest.hexdigest()


def _known(kept: Path, state: str) -> dict[str, str]:
    """Digests found before for this state of the package."""
    try:
        found = parse_json(kept.read_bytes())
        return dict(found["digests"]) if found["state"] == state else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _digest_of(roots: tuple[str, ...], root: Path) -> str:
    found = _reach(roots, root)
    digest = hashlib.sha256()
    for key in sorted(found):
        digest.update(":".join(key).encode())
        for text in found[key]:
            digest.update(text)
    return digest.hexdigest()[:16]


def reached(*roots: Code, root: Path = ROOT) -> list[str]:
    """What `code_digest` digests: definitions as "module:name", sorted."""
    places = tuple(_place(each) for each in roots)
    return [f"{module}:{name}" for module, name in sorted(_reach(places, root)) if name]


def _place(code: Code) -> str:
    return code if isinstance(code, str) else f"{code.__module__}:{code.__qualname__.split('.')[0]}"


# ---- following names ------------------------------------------------------------------------------


def _reach(roots: tuple[str, ...], root: Path) -> dict[Key, list[bytes]]:
    """Every definition that is reached, with those parts of its text that count."""
    found: dict[Key, list[bytes]] = {}
    waiting: list[tuple[str, str]] = []

    def reach(module: str, name: str) -> None:
        if module == __name__:  # how code is identified changes no result
            return
        if (module, name) not in found:
            found[module, name] = []
            waiting.append((module, name))

    def follow(module: str, chain: tuple[str, ...]) -> str:
        """Reach what a dotted name means in a module; return what an imported name refers to."""
        statement = _module(module, root).bindings.get(chain[0])
        if statement is None:
            return ""
        target = statement.imports.get(chain[0])
        if target is None:
            reach(module, chain[0])
            return ""
        return follow_import(module, target, chain[1:])

    def follow_import(module: str, target: "_Import", rest: tuple[str, ...]) -> str:
        source, name = target.module, target.name
        if source.split(".")[0] != PACKAGE:
            return f"{source}.{name}"
        if name and _path(f"{source}.{name}", root) is not None:
            source, name = f"{source}.{name}", ""
        while not name and rest and _path(f"{source}.{rest[0]}", root) is not None:
            source, rest = f"{source}.{rest[0]}", rest[1:]
        if not name and rest:
            name = rest[0]
        if _path(source, root) is None:
            raise HilsplatError(f"{module} imports {source}, which does not exist under {root}")
        if not name:  # the module itself is passed around
            for each in _module(source, root).bindings:
                follow(source, (each,))
        elif name in _module(source, root).bindings:
            follow(source, (name,))
        else:
            raise HilsplatError(f"{module} uses {name!r} of {source}, which does not define it")
        return f"{source}.{name}"

    for place in roots:
        module, _, name = place.partition(":")
        if _path(module, root) is None:
            raise HilsplatError(f"module {module} does not exist under {root}")
        known = _module(module, root).bindings
        if name and name not in known:
            raise HilsplatError(f"{module} does not define {name!r}", expected=f"one of {', '.join(known)}")
        for each in [name] if name else known:
            follow(module, (each,))
            for chain in known[each].signature:
                follow(module, chain)
    while waiting:
        module, name = waiting.pop()
        facts = _module(module, root)
        if name:
            reach(module, "")
            statements: Iterable[_Statement] = [facts.bindings[name]]
        else:
            statements = facts.effects
            packages = module.split(".")[:-1]
            for depth in range(len(packages)):
                reach(".".join(packages[: depth + 1]), "")
        for statement in statements:
            means = {chain[0]: follow(module, chain) for chain in statement.names}
            inner = [follow_import(module, target, rest) for target, rest in statement.inner]
            found[module, name] += [statement.text, repr((sorted(means.items()), sorted(inner))).encode()]
    return found


# ---- reading modules ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Import:
    """What an imported name means: a module, or a name in one."""

    module: str
    name: str


@dataclass
class _Statement:
    """A statement at the top of a module.

    Attributes:
        text: the parts that count.
        names: dotted names that it looks up in the module.
        inner: what it imports itself, inside functions, and the attributes that it takes from that.
        imports: for import statements, what each name means.
        signature: names in the annotations of a function's arguments, or of a class's methods.
    """

    text: bytes = b""
    names: list[tuple[str, ...]] = field(default_factory=list)
    inner: list[tuple[_Import, tuple[str, ...]]] = field(default_factory=list)
    imports: dict[str, _Import] = field(default_factory=dict)
    signature: list[tuple[str, ...]] = field(default_factory=list)


@dataclass
class _Module:
    """The statements of a module: those that bind names, by name, and those that importing runs."""

    bindings: dict[str, _Statement] = field(default_factory=dict)
    effects: list[_Statement] = field(default_factory=list)


@functools.cache
def _path(module: str, root: Path) -> Path | None:
    parts = module.split(".")
    if parts[0] != PACKAGE:
        return None
    base = root.joinpath(*parts[1:])
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)


@functools.cache
def _module(module: str, root: Path) -> _Module:
    path = _path(module, root)
    assert path is not None, module
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    return _parse(path.read_text(encoding="utf-8"), package)


@functools.cache
def _parse(text: str, package: str) -> _Module:
    facts = _Module()
    for node in ast.parse(text).body:
        if _is_bare_string(node):
            continue
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports = _imports(node, package)
            for name in imports:
                facts.bindings[name] = _Statement(imports=imports)
            continue
        if isinstance(node, ast.If) and _chain(node.test)[-1:] == ("TYPE_CHECKING",):
            for inner in node.body:
                imports = _imports(inner, package)
                facts.bindings.update({name: _Statement(imports=imports) for name in imports})
            continue
        statement = _statement(node, package)
        names = _bound_at_top(node)
        for name in names:
            if (earlier := facts.bindings.get(name)) is not None:  # bound twice: both count
                statement = _both(earlier, statement)
            facts.bindings[name] = statement
        if not names or _registers(node):
            facts.effects.append(statement)
    return facts


def _statement(node: ast.stmt, package: str) -> _Statement:
    signature: list[tuple[str, ...]] = []
    for inner in (node, *getattr(node, "body", ())):  # a function, or the methods of a class
        if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
            for annotation in _annotations(inner):
                signature += _Names(package).of(annotation)[0]
    _strip(node)
    names, inner = _Names(package).of(node)
    return _Statement(ast.dump(node).encode(), names, inner, signature=signature)


def _both(one: _Statement, other: _Statement) -> _Statement:
    return _Statement(
        one.text + other.text,
        one.names + other.names,
        one.inner + other.inner,
        {**one.imports, **other.imports},
        one.signature + other.signature,
    )


def _imports(node: ast.stmt, package: str) -> dict[str, _Import]:
    """Meaning of each name that an import statement binds."""
    if isinstance(node, ast.Import):
        return {
            alias.asname or alias.name.split(".")[0]: _Import(
                alias.name if alias.asname else alias.name.split(".")[0], ""
            )
            for alias in node.names
        }
    if not isinstance(node, ast.ImportFrom):
        return {}
    base = node.module or ""
    if node.level:
        parents = package.split(".")
        parent = parents[: len(parents) - node.level + 1]
        base = ".".join([*parent, *([base] if base else [])])
    if any(alias.name == "*" for alias in node.names) and base.split(".")[0] == PACKAGE:
        raise HilsplatError(f"a star import of {base} in {package} hides what is used", fix="name the names")
    return {alias.asname or alias.name: _Import(base, alias.name) for alias in node.names}


def _bound_at_top(node: ast.stmt) -> list[str]:
    """Names that a statement binds in its module, also inside its blocks."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    return sorted(_bound(node))


def _registers(node: ast.stmt) -> bool:
    """Whether a decorator may register what it decorates."""
    decorators = getattr(node, "decorator_list", ())
    chains = [_chain(each.func if isinstance(each, ast.Call) else each) for each in decorators]
    return any(not chain or chain[-1] not in NEUTRAL_DECORATORS for chain in chains)


# ---- what does not count --------------------------------------------------------------------------


def _is_bare_string(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _annotations(node: ast.FunctionDef | ast.AsyncFunctionDef) -> list[ast.expr]:
    args = node.args
    every = [*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg]
    return [each.annotation for each in every if each is not None and each.annotation is not None]


def _strip(top: ast.AST) -> None:
    """Take out of a syntax tree, in place, what cannot change a result."""
    waiting = [(top, False)]
    while waiting:
        node, is_local = waiting.pop()  # local: a statement of a function, whose annotations do nothing
        for block in ("body", "orelse", "finalbody"):
            statements = getattr(node, block, None)
            if isinstance(statements, list):
                kept = [each for each in statements if not _is_bare_string(each)]
                setattr(node, block, kept or ([ast.Pass()] if statements else []))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            args = node.args
            for each in (*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg):
                if each is not None:
                    each.annotation = None
            node.returns = None
            is_local = True
        elif isinstance(node, ast.ClassDef):
            is_local = False
        elif isinstance(node, ast.AnnAssign) and is_local:
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and _is_log_call(node.value)):
            for inner in ast.walk(node):
                if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                    inner.value = ""
                elif isinstance(inner, ast.JoinedStr):  # its words also separate its values
                    inner.values = [part for part in inner.values if isinstance(part, ast.FormattedValue)]
        elif isinstance(node, ast.Call):
            called = (_chain(node.func) or ("",))[-1]
            node.keywords = [each for each in node.keywords if each.arg not in PROSE.get(called, ())]
            if called == "knob":
                node.args = node.args[:1]  # the second is its description
            elif called == "Plugins":
                node.args = []
        waiting += [(child, is_local) for child in _children(node)]


_LEAVES = (ast.expr_context, ast.operator, ast.unaryop, ast.boolop, ast.cmpop)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes right below one, but for those that hold nothing, such as operators."""
    for name in node._fields:
        value = getattr(node, name, None)
        if isinstance(value, list):
            for each in value:
                if isinstance(each, ast.AST) and not isinstance(each, _LEAVES):
                    yield each
        elif isinstance(value, ast.AST) and not isinstance(value, _LEAVES):
            yield value


def _is_log_call(node: ast.AST) -> bool:
    chain = _chain(node.func) if isinstance(node, ast.Call) else ()
    return chain[:1] == ("logger",) and chain[-1] in LOG_METHODS


def _chain(node: ast.AST) -> tuple[str, ...]:
    """A dotted name as its parts; empty for other expressions."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return (node.id, *reversed(parts)) if isinstance(node, ast.Name) else ()


# ---- names and scopes -----------------------------------------------------------------------------

_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
_COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


@dataclass
class _Scope:
    """Names of a function, comprehension or class, and the meaning of those that it imports."""

    names: set[str]
    imports: dict[str, _Import]
    is_class: bool = False


class _Names:
    """Finds the names that a statement looks up outside itself."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.scopes: list[_Scope] = []
        self.names: dict[tuple[str, ...], None] = {}
        self.inner: dict[tuple[_Import, tuple[str, ...]], None] = {}

    def of(self, node: ast.AST) -> tuple[list[tuple[str, ...]], list[tuple[_Import, tuple[str, ...]]]]:
        """Dotted names of the module, and what is taken from modules that functions import themselves."""
        self._visit(node)
        return list(self.names), list(self.inner)

    def _visit(self, node: ast.AST) -> None:
        chain = _chain(node)
        if chain:
            self._look_up(chain)
        elif isinstance(node, _FUNCTIONS):
            defaults = [*node.args.defaults, *node.args.kw_defaults]
            for outside in (*getattr(node, "decorator_list", ()), *filter(None, defaults)):
                self._visit(outside)
            body = node.body if isinstance(node.body, list) else [node.body]
            arguments = {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
            bound = arguments | _bound_in(body) - _declared_global(body)
            self._inside(_Scope(bound, self._imported(body)), body)
        elif isinstance(node, ast.ClassDef):
            for outside in (*node.decorator_list, *node.bases, *node.keywords):
                self._visit(outside)
            scope = _Scope(_bound_in(node.body), self._imported(node.body), is_class=True)
            self._inside(scope, node.body)
        elif isinstance(node, _COMPREHENSIONS):
            self._inside(_Scope(_bound(node), {}), list(_children(node)))
        else:
            for child in _children(node):
                self._visit(child)

    def _inside(self, scope: _Scope, body: Sequence[ast.AST]) -> None:
        self.scopes.append(scope)
        for each in body:
            self._visit(each)
        self.scopes.pop()

    def _look_up(self, chain: tuple[str, ...]) -> None:
        for depth, scope in enumerate(reversed(self.scopes)):
            if scope.is_class and depth:
                continue  # methods do not see the names of their class
            if chain[0] in scope.imports:
                self.inner[scope.imports[chain[0]], chain[1:]] = None
                return
            if chain[0] in scope.names and not scope.is_class:
                return
        self.names[chain] = None

    def _imported(self, body: Sequence[ast.AST]) -> dict[str, _Import]:
        found: dict[str, _Import] = {}
        for node in _own(body):
            if isinstance(node, ast.Import | ast.ImportFrom):
                found |= _imports(node, self.package)
        return found


def _own(body: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Nodes of a block, without those inside functions and classes that it defines."""
    waiting = list(body)
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, (*_FUNCTIONS, ast.ClassDef)):
            waiting += _children(node)


def _bound_in(body: Iterable[ast.AST]) -> set[str]:
    """Names that a block binds."""
    names: set[str] = set()
    for node in _own(body):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del):
            names.add(node.id)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            names |= {alias.asname or alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            names.add(node.name)
        elif isinstance(node, ast.MatchMapping) and node.rest:
            names.add(node.rest)
    return names


def _bound(node: ast.AST) -> set[str]:
    return _bound_in([node])


def _declared_global(body: Iterable[ast.AST]) -> set[str]:
    return {name for node in _own(body) if isinstance(node, ast.Global) for name in node.names}
