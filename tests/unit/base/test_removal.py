"""Deletion and replacement: one module does it, and clean-up keeps what it did not create."""

import ast
from pathlib import Path

import pytest

import hilsplat
from hilsplat.base.removal import delete, is_tagged, tag, undone_on_error

PACKAGE = Path(hilsplat.__file__).parent
METHODS = {"rmtree", "unlink", "rmdir", "rename", "renames", "removedirs", "move"}
OF_OS = {"remove", "replace"}  # methods of other objects have these names, too


def removals(path: Path) -> list[str]:
    """Return the calls in a module that delete or rename files."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
            continue
        name, owner = node.func.attr, ast.unparse(node.func.value)
        is_of_path = name == "replace" and len(node.args) == 1 and not node.keywords
        if name in METHODS or (name in OF_OS and owner in ("os", "shutil")) or is_of_path:
            found.append(f"{path.relative_to(PACKAGE.parent)}:{node.lineno} {ast.unparse(node.func)}")
    return found


def test_no_other_module_deletes_or_renames():
    modules = sorted(PACKAGE.rglob("*.py"))
    assert len(removals(PACKAGE / "base/removal.py")) > 8
    found = [call for path in modules if path.name != "removal.py" for call in removals(path)]
    assert [call for call in found if not call.endswith(ALLOWED)] == []


ALLOWED = ("shown.rename", "rows.replace", "temporary.replace")
"""The names of nodes, the fields of a record, and `atomic_path`."""


def test_a_file_is_deleted_only_if_its_name_has_the_form(tmp_path):
    for name in ("0123.npz", "drawing.npz"):
        (tmp_path / name).touch()
    delete(tmp_path / "0123.npz", r"[0-9a-f]{4}\.npz")
    delete(tmp_path / "4567.npz", r"[0-9a-f]{4}\.npz")
    with pytest.raises(ValueError, match="may not be deleted"):
        delete(tmp_path / "drawing.npz", r"[0-9a-f]{4}\.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["drawing.npz"]


def test_a_deleted_link_keeps_its_target(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/drawing.png").touch()
    (tmp_path / "entry").symlink_to(tmp_path / "mine")
    delete(tmp_path / "entry", "entry")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["drawing.png", "mine"]


def test_a_folder_with_another_tag_is_not_ours(tmp_path):
    assert not is_tagged(tmp_path)
    (tmp_path / "CACHEDIR.TAG").write_text("Signature: 8a477f597d28d172789f06886806bc55")
    assert not is_tagged(tmp_path)
    tag(tmp_path / "ours")
    assert is_tagged(tmp_path / "ours")


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_cleanup_keeps_files_that_were_added_meanwhile(tmp_path, error):
    for name in ("made/a.png", "made/deeper/b.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(error), undone_on_error(tmp_path / "made"):
        (tmp_path / "made/mine.txt").touch()
        raise error
    assert [path.name for path in sorted(tmp_path.rglob("*"))] == ["made", "mine.txt"]
