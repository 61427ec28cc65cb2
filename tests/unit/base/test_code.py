"""A code digest covers the modules that a function imports, and changes with their code only."""

import ast
import functools
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from hilsplat.base import code
from hilsplat.base.code import code_digest, modules_of
from hilsplat.base.errors import HilsplatError
from hilsplat.baselines import BASELINES
from hilsplat.datasets.registry import DATASETS
from hilsplat.stages import all_stages, stage_of


@pytest.fixture
def forget(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], None]:
    """Search packages in `tmp_path`; return a function that clears the caches, as a new process would."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(code, "MEMO", tmp_path / "memo.json")
    cached = (code._closure, code._memo, code._file)
    for function in cached:
        monkeypatch.setattr(code, function.__name__, functools.cache(function.__wrapped__))
    return lambda: [getattr(code, function.__name__).cache_clear() for function in cached]


def write(folder: Path, **modules: str) -> None:
    """Write a package `plug` with these modules; `sub_b` is `plug.sub.b`."""
    for name, text in modules.items():
        path = folder.joinpath("plug", *name.split("_")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        for parent in {folder / "plug", path.parent}:
            (parent / "__init__.py").touch()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import numpy, plug.sub.b as b", {"sub.b"}),
        ("from plug.sub import b", {"sub.b"}),
        ("from plug.sub.b import f", {"sub.b"}),
        ("from plug.sub import name", {"sub"}),
        ("from plug.sub import *", {"sub"}),
        ("from .sub.b import f", {"sub.b"}),
        ("def g():\n    from plug import c", {"c"}),
        ("if True:\n    import plug.c\nelse:\n    import plug.sub.b", {"c", "sub.b"}),
        ("try:\n    import plug.compiled\nexcept ImportError:\n    import plug.c", {"", "c"}),
        ("if TYPE_CHECKING:\n    import plug.c\nelse:\n    import plug.sub.b", {"sub.b"}),
        ("if not TYPE_CHECKING:\n    import plug.c", {"c"}),
        ("import plug.circle", {"circle"}),
        ("from hilsplat.base.levels import Level", {"hilsplat.base.errors", "hilsplat.base.levels"}),
        ("from hilsplat.settings import Settings", set()),
    ],
)
@pytest.mark.usefixtures("forget")
def test_imports_are_followed(tmp_path, text, expected):
    write(tmp_path, a=text, sub_b="def f(): ...", c="", circle="import plug.a")
    found = {name.removeprefix("plug").removeprefix(".") for name in modules_of("plug.a:g")}
    assert found == expected | {"a"}


@pytest.mark.usefixtures("forget")
def test_relative_imports_start_at_the_package_and_modules_may_have_none(tmp_path):
    write(tmp_path, sub_b="from .. import c\nfrom . import d", sub_d="", c="")
    (tmp_path / "alone.py").write_text("import plug.c, plug.sub")
    assert modules_of("plug.sub.b") == ["plug.c", "plug.sub.b", "plug.sub.d"]
    assert modules_of("alone:f") == ["alone"]
    with pytest.raises(HilsplatError, match=r"there is no module plug\.zzz"):
        code_digest("plug.zzz:f")


BEFORE = '''"""Module."""
from plug.c import h
ONE = 1
"""What it is."""
class C:
    """Class."""
    def f(self): # comment
        return "text"
'''


@pytest.mark.parametrize(
    ("name", "old", "new", "counts"),
    [
        ("a", '"""Module."""\n', "", False),
        ("a", "What it is", "What it was", False),
        ("a", " # comment", "", False),
        ("a", '"text"', '"words"', True),
        ("a", "class C:", "@decorated\nclass C:", True),
        ("c", "", "X = 1", True),
        ("d", "", "X = 1", False),
    ],
)
def test_comments_docstrings_and_modules_not_imported_do_not_count(tmp_path, forget, name, old, new, counts):
    texts = {"a": BEFORE, "c": "", "d": ""}
    write(tmp_path, **texts)
    before = code_digest("plug.a")
    write(tmp_path, **{name: texts[name].replace(old, new, 1)})
    assert code_digest("plug.a") == before, "a process keeps the digest of its code"
    forget()
    assert (code_digest("plug.a") != before) is counts


@pytest.mark.parametrize("suffix", ["json", "tsv"])
def test_data_beside_a_module_count(tmp_path, forget, suffix):
    write(tmp_path, a="")
    digests = [code_digest("plug.a")]
    for text in ("1", "2"):
        (tmp_path / f"plug/a.{suffix}").write_text(text)
        forget()
        digests.append(code_digest("plug.a"))
    assert len(set(digests)) == 3


def test_unchanged_modules_are_parsed_once_whatever_is_in_the_memo(tmp_path, forget, monkeypatch):
    write(tmp_path, a="import plug.c", c="")
    digest = code_digest("plug.a")
    memo = code.MEMO.read_text()
    os.utime(tmp_path / "plug/a.py", (1, 1))  # as in another checkout
    forget()
    with monkeypatch.context() as patch:
        patch.setattr(ast, "parse", None)
        assert code_digest("plug.a") == digest
    facts = json.loads(memo)
    for damaged in ("", "[]", memo[:-9], json.dumps({**facts, "plug.c": facts["plug.c"][:2]})):
        code.MEMO.write_text(damaged)
        forget()
        assert code_digest("plug.a") == digest
        assert code.MEMO.read_text() == memo
    code.MEMO.unlink()
    monkeypatch.setattr(code, "MEMO", tmp_path / "plug/a.py/memo.json")  # a folder that cannot be written
    forget()
    assert code_digest("plug.a") == digest


def test_every_stage_and_plugin_has_its_code_and_nothing_else_is_imported_by_string(project):
    for place in (*DATASETS.places.values(), *(method.fit for method in BASELINES.values())):
        assert place.partition(":")[0] in modules_of(place)
    assert all(stage.modules() and stage.code_digest() for stage in all_stages().values())
    assert "hilsplat.semantic_tree.linkage" in stage_of("semantic_tree").modules()
    assert "hilsplat.semantic_tree.linkage" not in stage_of("masks").modules()
    texts = {path: path.read_text() for path in (project / "hilsplat").rglob("*.py")}
    by_string = [path for path, text in texts.items() if "import_module" in text or "__import__(" in text]
    assert {path.name for path in by_string} == {"plugins.py", "__init__.py"}
