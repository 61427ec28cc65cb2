"""The code digest follows what runs, and nothing else."""

from pathlib import Path

import pytest

from hilsplat.base.code_hash import code_hash, import_closure
from hilsplat.base.errors import HilsplatError


def package(folder: Path, **modules: str) -> Path:
    """A package `hilsplat` with the given modules."""
    root = folder / "hilsplat"
    root.mkdir(parents=True)
    (root / "__init__.py").write_text("")
    for name, text in modules.items():
        (root / f"{name}.py").write_text(text)
    return root


def digest(folder: Path, **modules: str) -> str:
    return code_hash("hilsplat.a", root=package(folder, **modules))


BASE = {"a": "from hilsplat.b import f\n\ndef g():\n    return f()\n", "b": "def f():\n    return 1\n"}


def test_comments_docstrings_and_spaces_do_not_count(tmp_path: Path) -> None:
    edited = {
        "a": '"""Now with a docstring."""\nfrom hilsplat.b import f  # a comment\n\n\ndef g():\n'
        '    """And one here."""\n    return  f()\n',
        "b": BASE["b"],
    }
    assert digest(tmp_path / "1", **BASE) == digest(tmp_path / "2", **edited)


def test_an_edit_in_an_imported_module_counts(tmp_path: Path) -> None:
    edited = {**BASE, "b": "def f():\n    return 2\n"}
    assert digest(tmp_path / "1", **BASE) != digest(tmp_path / "2", **edited)


def test_an_unrelated_module_does_not_count(tmp_path: Path) -> None:
    assert digest(tmp_path / "1", **BASE) == digest(tmp_path / "2", **BASE, c="x = 1\n")


def test_imports_inside_functions_and_relative_ones_are_followed(tmp_path: Path) -> None:
    root = package(
        tmp_path, a="def g():\n    from . import b\n    return b.f()\n", b="import hilsplat.c\n", c=""
    )
    assert import_closure("hilsplat.a", root=root) == ["hilsplat", "hilsplat.a", "hilsplat.b", "hilsplat.c"]


def test_a_missing_module_is_named(tmp_path: Path) -> None:
    with pytest.raises(HilsplatError, match=r"module hilsplat\.zzz does not exist"):
        code_hash("hilsplat.zzz", root=package(tmp_path, a=""))


def test_every_stage_has_a_module_and_no_module_is_imported_by_string(project: Path) -> None:
    from hilsplat.cli.stage_modules import STAGE_MODULES

    for stage, module in STAGE_MODULES.items():
        assert code_hash(module), stage
    texts = {path: path.read_text() for path in (project / "hilsplat").rglob("*.py")}
    by_string = [path for path, text in texts.items() if "import_module" in text or "__import__(" in text]
    # baselines, whose modules the workflow and the provenance hash by name
    assert by_string == [project / "hilsplat/methods/registry.py"]


def test_package_inits_are_empty(project: Path) -> None:
    assert [p for p in (project / "hilsplat").rglob("__init__.py") if p.read_text().strip()] == []
