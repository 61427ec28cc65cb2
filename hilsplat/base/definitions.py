"""The parts of a module's definitions that can change a result: their text and the names they look up."""

import ast
import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hilsplat.base.errors import HilsplatError

PACKAGE = "hilsplat"

NEUTRAL_DECORATORS = {
    *("cache", "cached_property", "compiled", "contextmanager", "dataclass", "lru_cache"),
    *("no_type_check", "overload"),
}
"""Decorators that register nothing: a definition with only these decorators counts only if it is reached."""

PROSE = {
    "knob": ("unit", "origin"),
    "Dataset": ("licence", "terms", "citation", "layout"),
    "Segments": ("licence", "terms", "citation", "layout"),
}
"""Name of a called function or class -> the keyword arguments that only document it."""

LOG_METHODS = {"debug", "info", "warning", "error", "exception"}


@dataclass(frozen=True)
class Import:
    """Target of an imported name: a module, or a name in a module."""

    module: str
    name: str


@dataclass
class Statement:
    """A statement at the top of a module.

    Attributes:
        text: the parts that can change a result.
        names: dotted names that the statement looks up in the module.
        inner: imports inside its functions, each with the attributes used from it.
        imports: for import statements, the target of each name.
        signature: names in the argument annotations of a function, or of a class's methods.
    """

    text: bytes = b""
    names: list[tuple[str, ...]] = field(default_factory=list)
    inner: list[tuple[Import, tuple[str, ...]]] = field(default_factory=list)
    imports: dict[str, Import] = field(default_factory=dict)
    signature: list[tuple[str, ...]] = field(default_factory=list)

    def __add__(self, other: "Statement") -> "Statement":
        text, names, inner = self.text + other.text, self.names + other.names, self.inner + other.inner
        return Statement(text, names, inner, self.imports | other.imports, self.signature + other.signature)


@dataclass
class Module:
    """Statements of a module: those that bind names, by name, and those that have effects on import."""

    bindings: dict[str, Statement] = field(default_factory=dict)
    effects: list[Statement] = field(default_factory=list)


@functools.cache
def path_of(module: str, root: Path) -> Path | None:
    parts = module.split(".")
    if parts[0] != PACKAGE:
        return None
    base = root.joinpath(*parts[1:])
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)


@functools.cache
def module_of(module: str, root: Path) -> Module:
    path = path_of(module, root)
    assert path is not None, module
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    return _parse(path.read_text(encoding="utf-8"), package)


@functools.cache
def _parse(text: str, package: str) -> Module:
    facts = Module()
    for node in ast.parse(text).body:
        if _is_bare_string(node):
            continue
        for_types = isinstance(node, ast.If) and _chain(node.test)[-1:] == ("TYPE_CHECKING",)
        if for_types or isinstance(node, ast.Import | ast.ImportFrom):
            for inner in getattr(node, "body", [node]):
                imports = _imports(inner, package)
                facts.bindings.update({name: Statement(imports=imports) for name in imports})
            continue
        statement = _statement(node, package)
        names = sorted(_bound_in([node], package))
        for name in names:
            if (earlier := facts.bindings.get(name)) is not None:  # bound twice: both count
                statement = earlier + statement
            facts.bindings[name] = statement
        if not names or _registers(node):
            facts.effects.append(statement)
    return facts


def _statement(node: ast.stmt, package: str) -> Statement:
    signature: list[tuple[str, ...]] = []
    for inner in (node, *getattr(node, "body", ())):  # a function, or the methods of a class
        if isinstance(inner, ast.FunctionDef | ast.AsyncFunctionDef):
            for argument in _arguments(inner.args):
                if argument.annotation is not None:
                    signature += _Names(package).of(argument.annotation)[0]
    _strip(node)
    names, inner = _Names(package).of(node)
    return Statement(ast.dump(node).encode(), names, inner, signature=signature)


def _imports(node: ast.stmt, package: str) -> dict[str, Import]:
    """Return the target of each name that an import statement binds."""
    if isinstance(node, ast.Import):
        whole = {alias.asname: alias.name for alias in node.names if alias.asname}
        tops = [alias.name.split(".")[0] for alias in node.names if not alias.asname]
        return {name: Import(module, "") for name, module in {**whole, **{top: top for top in tops}}.items()}
    if not isinstance(node, ast.ImportFrom):
        return {}
    base = node.module or ""
    if node.level:
        parents = package.split(".")
        parent = parents[: len(parents) - node.level + 1]
        base = ".".join([*parent, *([base] if base else [])])
    if any(alias.name == "*" for alias in node.names) and base.split(".")[0] == PACKAGE:
        raise HilsplatError(f"a star import of {base} in {package} hides the names used", fix="list them")
    return {alias.asname or alias.name: Import(base, alias.name) for alias in node.names}


def _registers(node: ast.stmt) -> bool:
    """Return whether a decorator may register the definition."""
    decorators = getattr(node, "decorator_list", ())
    chains = [_chain(each.func if isinstance(each, ast.Call) else each) for each in decorators]
    return any(not chain or chain[-1] not in NEUTRAL_DECORATORS for chain in chains)


# ---- removal of irrelevant parts ------------------------------------------------------------------


def _is_bare_string(node: ast.AST) -> bool:
    value = getattr(node, "value", None) if isinstance(node, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)


def _arguments(arguments: ast.arguments) -> list[ast.arg]:
    return [each for each in ast.walk(arguments) if isinstance(each, ast.arg)]


def _strip(top: ast.AST) -> None:
    """Remove, in place, the parts of a syntax tree that cannot change a result."""
    waiting = [(top, False)]
    while waiting:
        node, is_local = waiting.pop()  # local: inside a function, where annotations have no effect
        for block in ("body", "orelse", "finalbody"):
            statements = getattr(node, block, None)
            if isinstance(statements, list):
                kept = [each for each in statements if not _is_bare_string(each)]
                setattr(node, block, kept or ([ast.Pass()] if statements else []))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            for argument in _arguments(node.args):
                argument.annotation = None
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
                elif isinstance(inner, ast.JoinedStr):  # even empty literals would change the digest
                    inner.values = [part for part in inner.values if isinstance(part, ast.FormattedValue)]
        elif isinstance(node, ast.Call):
            called = (_chain(node.func) or ("",))[-1]
            node.keywords = [each for each in node.keywords if each.arg not in PROSE.get(called, ())]
            if called == "knob":
                node.args = node.args[:1]  # the second argument is the description
            elif called == "Plugins":
                node.args = []
        waiting += [(child, is_local) for child in ast.iter_child_nodes(node)]


def _is_log_call(node: ast.AST) -> bool:
    chain = _chain(node.func) if isinstance(node, ast.Call) else ()
    return chain[:1] == ("logger",) and chain[-1] in LOG_METHODS


def _chain(node: ast.AST) -> tuple[str, ...]:
    """Return the parts of a dotted name, or an empty tuple."""
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
    """Names bound by a function, comprehension or class, each with its import target or None."""

    bound: dict[str, Import | None]
    is_class: bool = False


class _Names:
    """Collector of the names that a statement looks up outside itself."""

    def __init__(self, package: str) -> None:
        self.package = package
        self.scopes: list[_Scope] = []
        self.names: dict[tuple[str, ...], None] = {}
        self.inner: dict[tuple[Import, tuple[str, ...]], None] = {}

    def of(self, node: ast.AST) -> tuple[list[tuple[str, ...]], list[tuple[Import, tuple[str, ...]]]]:
        """Return the dotted names looked up in the module, and those used from imports inside functions."""
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
            arguments: dict[str, Import | None] = {each.arg: None for each in _arguments(node.args)}
            self._inside(_Scope(arguments | _bound_in(body, self.package)), body)
        elif isinstance(node, ast.ClassDef):
            for outside in (*node.decorator_list, *node.bases, *node.keywords):
                self._visit(outside)
            self._inside(_Scope(_bound_in(node.body, self.package), is_class=True), node.body)
        elif isinstance(node, _COMPREHENSIONS):
            self._inside(_Scope(_bound_in([node], self.package)), list(ast.iter_child_nodes(node)))
        else:
            for child in ast.iter_child_nodes(node):
                self._visit(child)

    def _inside(self, scope: _Scope, body: Sequence[ast.AST]) -> None:
        self.scopes.append(scope)
        for each in body:
            self._visit(each)
        self.scopes.pop()

    def _look_up(self, chain: tuple[str, ...]) -> None:
        for depth, scope in enumerate(reversed(self.scopes)):
            if scope.is_class and depth:
                continue  # names of a class are not in scope in its methods
            target = scope.bound.get(chain[0])
            if target is not None:
                self.inner[target, chain[1:]] = None
                return
            if chain[0] in scope.bound and not scope.is_class:
                return
        self.names[chain] = None


def _bound_in(body: Iterable[ast.AST], package: str) -> dict[str, Import | None]:
    """Return the names that a block binds in its own scope, each with its import target or None."""
    names: set[str] = set()
    imports: dict[str, Import] = {}
    declared_global: set[str] = set()
    waiting = list(body)
    while waiting:
        node = waiting.pop()
        if not isinstance(node, (*_FUNCTIONS, ast.ClassDef)):  # these have their own scope
            waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store | ast.Del):
            names.add(node.id)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            imports |= _imports(node, package)
        elif isinstance(node, ast.ExceptHandler) and node.name:
            names.add(node.name)
        elif isinstance(node, ast.Global):
            declared_global |= set(node.names)
    return {**dict.fromkeys(names - declared_global), **imports}
