"""A code digest covers the modules that a function imports, and changes with their code only."""

import ast
import builtins
import dis
import functools
import inspect
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FunctionType

import pytest

from hilsplat.base import code
from hilsplat.base.code import code_digest, modules_of, statements_of
from hilsplat.base.errors import HilsplatError
from hilsplat.base.plugins import load
from hilsplat.baselines import BASELINES
from hilsplat.datasets.registry import DATASETS
from hilsplat.settings import Section
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


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("from plug.sub import b", ["plug.sub.b"]),
        ("from plug.sub.b import f", ["plug.sub.b"]),
        ("from ..c import f", ["plug.c"]),
        ("from . import b", ["plug.sub.b"]),
        ("import numpy, hilsplat.base.errors", ["hilsplat.base.errors"]),
    ],
)
@pytest.mark.usefixtures("forget")
def test_a_stage_covers_modules_that_its_body_imports_in_any_form(tmp_path, line, expected):
    text = "from hilsplat.stage import PathOut, Registry\nPIPELINE = Registry()\n"
    text += f'@PIPELINE.stage()\ndef count(out: PathOut) -> None:\n    """Count."""\n    {line}\n'
    write(tmp_path, sub_stages=text, sub_b="", c="")
    found = load("plug.sub.stages:PIPELINE").stages["count"].modules()
    for name in ("plug", "plug.sub", "plug.sub.stages"):
        del sys.modules[name]
    assert found == expected


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


@pytest.mark.usefixtures("forget")
def test_every_version_of_python_gives_the_same_digest(tmp_path):
    """Recorded with 3.11.7, 3.12.1 and 3.13.0, which represent some of these statements differently."""
    write(
        tmp_path, a=BEFORE + "def g(*a, b=None, **c):\n    print([f'{a!r:<{b}} {{}}'], {**c, 1: 'é'})\n", c=""
    )
    assert code_digest("plug.a") == "e806d86a6436de9e"


@pytest.mark.parametrize("suffix", ["json", "tsv", "txt"])
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


def test_the_memo_of_another_version_of_the_digest_is_not_used(tmp_path, forget, monkeypatch):
    write(tmp_path, a="")
    with monkeypatch.context() as patch:
        patch.setattr(code, "_own_code", lambda: b"older")
        patch.setattr(code, "_structure", lambda tree: "as older versions do")
        older = code_digest("plug.a")
    forget()
    assert code_digest("plug.a") != older


def test_every_stage_and_plugin_has_its_code_and_nothing_else_is_imported_by_string(project):
    for place in (*DATASETS.places.values(), *(method.fit for method in BASELINES.values())):
        assert place.partition(":")[0] in modules_of(place)
    assert all(stage.modules() and stage.code_digest() for stage in all_stages().values())
    assert "hilsplat.semantic_tree.linkage" in stage_of("semantic_tree").modules()
    assert "hilsplat.semantic_tree.linkage" not in stage_of("masks").modules()
    texts = {path: path.read_text() for path in (project / "hilsplat").rglob("*.py")}
    by_string = [path for path, text in texts.items() if "import_module" in text or "__import__(" in text]
    assert {path.name for path in by_string} == {"plugins.py", "__init__.py"}


NEUTRAL = ("hilsplat.settings.", "hilsplat.baselines.")
OF_CONFIGURATIONS = {
    *(f"hilsplat.settings.{name}" for name in ("LARGEST", "Share", "knob")),
    *(f"hilsplat.baselines.{name}" for name in ("method_of", "own_settings", "settings_class")),
}
"""What reads and describes configurations; a stage gets the values."""


def test_plugins_named_by_the_data_count_for_the_jobs_that_load_them():
    given = {"labels": None, "data_root": "", "truth": Path("truth"), "source": "world:tabletop:1"}
    assert "hilsplat_world.diagnostics.world_consistency" in modules_of(
        *stage_of("evaluate").reads(given).plugins
    )
    assert stage_of("evaluate").reads({**given, "source": ""}).plugins == ()
    listed = modules_of(*stage_of("table").reads({}).plugins)  # tables show the number of a data set's scenes
    assert {"hilsplat.datasets.images.lerf_ovs", "hilsplat.datasets.waymo.reader"} <= {*listed}


WHERE_AND_WHEN = {"is_random", "uses_model", "uses_card", "rasteriser"}
"""Properties of settings that decide whether and where a stage runs, not what it computes."""

NOT_OF_STAGES = {
    *("hilsplat/hub/pins.tsv", "hilsplat/models/releases.tsv"),
    *("hilsplat/workflow/gpu.json", "hilsplat/py.typed"),
}


def is_section(value):
    return isinstance(value, type) and issubclass(value, Section)


def test_modules_that_do_not_count_have_nothing_to_compute_with():
    modules = {module for stage in all_stages().values() for module in stage.modules()}
    facts = [code._facts(module, code._file(module), code._memo().get(module)) for module in modules]
    imports = {name for of_module in facts for name in of_module.imports if name.startswith(NEUTRAL)}
    sections = {name: cls for name in imports if is_section(cls := load(":".join(name.rsplit(".", 1))))}
    assert imports - {*sections} == OF_CONFIGURATIONS and len(sections) > 10
    for name, cls in sections.items():
        members = {key for key, each in vars(cls).items() if isinstance(each, (FunctionType, property))}
        assert members - {"__hash__"} <= WHERE_AND_WHEN, name


def test_a_module_that_reads_data_of_its_package_has_its_name(project):
    packages = [project / name for name in ("hilsplat", "cpusplat", "hilsplat_world")]
    files = {
        path for package in packages for path in package.rglob("*.*") if path.suffix not in (".py", ".smk")
    }
    data = {
        path for path in files if not {"static", "__pycache__"} & {*path.parts} and path.name != "README.md"
    }
    alone = {
        path
        for path in data
        if path.suffix not in (".json", ".tsv", ".txt") or not path.with_suffix(".py").is_file()
    }
    names = {path.relative_to(project).as_posix() for path in alone}
    assert names == NOT_OF_STAGES


def double(scene, out):
    """Do it twice."""
    return scene * 2  # at least


def triple(scene, out):
    return scene * 3


def test_the_body_of_a_stage_counts_and_uses_only_parameters_and_imports():
    assert statements_of(double) == "return scene * 2" != statements_of(triple)
    for stage in all_stages().values():
        steps = dis.get_instructions(inspect.unwrap(stage.function))
        names = {step.argval for step in steps if step.opname == "LOAD_GLOBAL"}
        assert names <= set(dir(builtins)), stage.name
    digests = [replace(stage_of("masks"), function=body).code_digest() for body in (double, triple)]
    assert len(set(digests)) == 2
