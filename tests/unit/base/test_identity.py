"""A code digest covers exactly the definitions that a function can reach."""

import ast
import json
import shutil
from pathlib import Path

import pytest

from hilsplat.base import definitions, identity
from hilsplat.base.errors import HilsplatError
from hilsplat.base.identity import code_digest, reached
from hilsplat.datasets.registry import DATASETS
from hilsplat.methods.registry import METHODS
from hilsplat.workflow.stages import STAGES

# ---- on packages of a few lines ---------------------------------------------------------------------


def package(folder: Path, **modules: str) -> Path:
    """Write a package `hilsplat` with these modules; `sub_b` is `hilsplat.sub.b`."""
    root = folder / "hilsplat"
    for name, text in modules.items():
        path = root.joinpath(*name.split("_")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        for parent in {root, path.parent}:
            (parent / "__init__.py").touch()
    return root


def found(folder: Path, **modules: str) -> set[str]:
    """Return the names that hilsplat.a:g reaches, without the package."""
    root = package(folder, **modules)
    return {name.removeprefix("hilsplat.") for name in reached("hilsplat.a:g", root=root)}


def same(folder: Path, one: dict[str, str], other: dict[str, str]) -> bool:
    """Return whether hilsplat.a:g has the same digest in two packages."""
    digests = {
        code_digest("hilsplat.a:g", root=package(folder / str(number), **modules))
        for number, modules in enumerate((one, other))
    }
    return len(digests) == 1


BASE = {
    "a": "from hilsplat.b import f\n\ndef g():\n    return f()\n\ndef aside():\n    return 3\n",
    "b": "ONE = 1\n\ndef f():\n    return ONE\n\ndef unused():\n    return 2\n",
}


@pytest.mark.parametrize(
    ("old", "new", "counts"),
    [
        ("def g():\n", 'def g():\n    """A docstring."""\n', False),
        ("    return f()\n", "    return  f()  # a comment\n", False),
        ("ONE = 1\n", 'ONE = 1\n"""What it is."""\n', False),
        ("return 2", "return 20", False),
        ("return 3", "return 30", False),
        ("return ONE", "return -ONE", True),
        ("ONE = 1", "ONE = 11", True),
        ("return f()", "return f(), 1", True),
        ("def unused", "class Another(Exception):\n    pass\n\ndef unused", False),
        ("from hilsplat.b import f", "from hilsplat.b import unused as f", True),
    ],
)
def test_only_reached_definitions_change_the_digest(tmp_path, old, new, counts):
    edited = {name: text.replace(old, new) for name, text in BASE.items()}
    assert edited != BASE
    assert same(tmp_path, BASE, edited) is not counts


@pytest.mark.parametrize(
    ("code", "old", "new", "counts"),
    [
        ('    raise ValueError("a word")', "a word", "two words", False),
        ('    raise ValueError(f"a word of {x}")', "a word", "two words", False),
        ('    raise ValueError(f"a word of {x}")', "{x}", "{x}, a row each", False),
        ('    raise ValueError(f"a word of {x}")', "{x}", "{y}", True),
        ('    raise ValueError("a word")', "ValueError", "KeyError", True),
        ('    logger.info("a word %s", x)', "a word", "two words", False),
        ('    logger.info("a word %s", x)', "x)", "y)", True),
        ('    return "a word"', "a word", "two words", True),
        ('    return knob(1, "a word", unit="px", ge=0)', "a word", "two words", False),
        ('    return knob(1, "a word", unit="px", ge=0)', "px", "mm", False),
        ('    return knob(1, "a word", unit="px", ge=0)', "(1", "(2", True),
        ('    return knob(1, "a word", unit="px", ge=0)', "ge=0", "ge=1", True),
        ('    return Dataset(name="x", licence="free")', "free", "yours", False),
        ('    return Dataset(name="x", licence="free")', '"x"', '"y"', True),
        ('    return Plugins({"x": "hilsplat.b:f"})', ":f", ":h", False),
        ("    y: int = x\n    return y", "int", "float", False),
    ],
)
def test_messages_and_descriptions_do_not_change_the_digest(tmp_path, code, old, new, counts):
    one = {"a": f"def g(x, y):\n{code}\n"}
    other = {"a": one["a"].replace(old, new)}
    assert one != other
    assert same(tmp_path, one, other) is not counts


def test_imports_inside_functions_relative_ones_and_attributes_of_modules_are_followed(tmp_path):
    a = "def g():\n    from . import b\n    return b.f()\n"
    b = "import hilsplat.c\n\ndef f():\n    return hilsplat.c.h()\n\ndef unused():\n    return 1\n"
    assert found(tmp_path, a=a, b=b, c="def h():\n    return 1\n") == {"a:g", "b:f", "c:h"}


def test_a_module_that_is_passed_around_counts_as_a_whole(tmp_path):
    a = "from hilsplat import b\n\ndef g():\n    return vars(b)\n"
    assert found(tmp_path, a=a, b="def f():\n    return 1\n\nX = 1\n") == {"a:g", "b:f", "b:X"}


def test_names_that_a_package_exports_lead_to_their_module(tmp_path):
    a = "from hilsplat.sub import f\n\ndef g():\n    return f()\n"
    root = package(tmp_path, a=a, sub_b="def f():\n    return 1\n", sub_c="def h():\n    return 1\n")
    exports = "from hilsplat.sub.b import f\nfrom hilsplat.sub.c import h\n"
    (root / "sub/__init__.py").write_text(exports)
    assert reached("hilsplat.a:g", root=root) == ["hilsplat.a:g", "hilsplat.sub.b:f"]


def test_a_local_name_hides_a_module_level_name(tmp_path):
    a = (
        "def x():\n    return 1\n\ndef y():\n    return 1\n\ndef z():\n    return 1\n\n"
        "def g(x):\n    y = 2\n    return x, y, [z for z in (1, 2)]\n"
    )
    assert found(tmp_path, a=a) == {"a:g"}


def test_methods_see_the_module_and_not_the_names_of_their_class(tmp_path):
    a = (
        "def f():\n    return 1\n\nclass C:\n    def f(self):\n        return f()\n\n"
        "class D:\n    def h(self):\n        return 1\n\ndef g(c: D):\n    return C()\n"
    )
    # D is where an argument of the root may come from
    assert found(tmp_path, a=a) == {"a:g", "a:C", "a:f", "a:D"}


def test_annotations_count_only_for_roots(tmp_path):
    a = "class D:\n    pass\n\ndef f(d: D) -> D:\n    return d\n\ndef g():\n    return f(1)\n"
    assert found(tmp_path, a=a) == {"a:g", "a:f"}


@pytest.mark.parametrize(
    ("statement", "counts"),
    [
        ("register(1)", True),
        ("TABLE[1] = 2", True),
        ("@register\ndef h():\n    return 1", True),
        ("@cache\ndef h():\n    return 1", False),
        ("TABLE = {1: 2}", False),
    ],
)
def test_statements_that_run_on_import_count(tmp_path, statement, counts):
    one = {"a": "from hilsplat.b import f\n\ndef g():\n    return f()\n", "b": "def f():\n    return 1\n"}
    other = {**one, "b": f"{one['b']}\n{statement}\n"}
    assert same(tmp_path, one, other) is not counts


def test_both_branches_that_bind_a_name_count(tmp_path):
    a = "try:\n    X = 1\nexcept ImportError:\n    X = {}\n\ndef g():\n    return X\n"
    one, other = ({"a": a.format(number)} for number in (2, 3))
    assert not same(tmp_path, one, other)


@pytest.mark.parametrize(
    ("root", "a", "message"),
    [
        ("hilsplat.zzz", "", r"module hilsplat\.zzz does not exist"),
        ("hilsplat.a:h", "def g():\n    pass\n", r"hilsplat\.a does not define 'h'"),
        (
            "hilsplat.a:g",
            "from hilsplat.b import x\n\ndef g():\n    x()\n",
            r"imports hilsplat\.b, which does not",
        ),
        (
            "hilsplat.a:g",
            "from hilsplat import a\n\ndef g():\n    a.x()\n",
            r"uses 'x' from hilsplat\.a, which",
        ),
        ("hilsplat.a:g", "from hilsplat.a import *\n\ndef g():\n    x()\n", r"a star import of hilsplat\.a"),
    ],
)
def test_missing_modules_and_names_are_named(tmp_path, root, a, message):
    with pytest.raises(HilsplatError, match=message):
        code_digest(root, root=package(tmp_path, a=a))


# ---- on this package --------------------------------------------------------------------------------


@pytest.fixture
def copy(project: Path, tmp_path: Path) -> Path:
    """A copy of the package."""
    no_caches = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(project / "hilsplat", tmp_path / "hilsplat", ignore=no_caches))


def changed(copy: Path, project: Path, places: dict[str, str] = STAGES, *roots: str) -> set[str]:
    """Return the places whose digest differs from the project's."""
    digests = [
        {name: code_digest(*roots, place, root=root) for name, place in places.items()}
        for root in (copy, project / "hilsplat")
    ]
    return {name for name in places if digests[0][name] != digests[1][name]}


def edit_function(root: Path, place: str) -> None:
    """Add a line to a function, named as "path.py:function"."""
    path, _, name = place.partition(":")
    tree = ast.parse((root / path).read_text())
    [function] = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == name]
    function.body.append(ast.parse("EDITED = 1").body[0])
    (root / path).write_text(ast.unparse(ast.fix_missing_locations(tree)))


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("segment/coverage.py:run_coverage_tree", {"coverage_tree"}),
        ("field/losses.py:part_loss_literal", {"field", "feature_tree"}),
        ("field/literal_trainer.py:train_literally", {"field"}),
        ("embed/langsplat_files.py:read_clip", {"langsplat"}),
        ("evaluate/tables/formats.py:as_html", {"table"}),
        ("query/field_answers.py:field_colours", {"evaluate", "figures", "comparison"}),
        ("segment/graph.py:segment_graph", {"masks", "key_masks", "guided_masks"}),
        ("cli/stage.py:stage", set()),
    ],
)
def test_an_edit_reruns_exactly_the_stages_that_can_reach_it(copy, project, place, expected):
    edit_function(copy, place)
    assert changed(copy, project) == expected


def test_readers_and_baselines_count_only_for_jobs_that_use_them(copy, project):
    edit_function(copy, "datasets/images/lerf_ovs.py:open_scene")
    edit_function(copy, "methods/lifted.py:fit")
    assert changed(copy, project) == set()

    for stage in ("evaluate", "figures", "comparison"):
        assert changed(copy, project, DATASETS.places, STAGES[stage]) == {"lerf_ovs"}
    assert changed(copy, project, METHODS.places, STAGES["method"]) == {"lifted"}


def test_every_stage_and_plugin_has_its_code_and_nothing_else_is_imported_by_string(project):
    for place in (*STAGES.values(), *DATASETS.places.values(), *METHODS.places.values()):
        assert reached(place), place
    texts = {path: path.read_text() for path in (project / "hilsplat").rglob("*.py")}
    by_string = [path for path, text in texts.items() if "import_module" in text or "__import__(" in text]
    assert by_string == [project / "hilsplat/base/plugins.py"]


def test_a_command_only_calls_the_function_of_its_stage(project):
    """Other code between the lock and the provenance record would be in no digest."""
    names = set()
    for path in (project / "hilsplat/cli").glob("*_commands.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            call = node.items[0].context_expr if isinstance(node, ast.With) else None
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "stage":
                names.add(ast.literal_eval(call.args[0]))
                assert len(node.body) == 1, (path.name, ast.unparse(call))
                function = ast.unparse(node.body[0].value.func).partition(".")[0]
                assert function == ast.unparse(node.items[0].optional_vars)
    assert set(STAGES) - names == {"efficiency"}


# ---- digests kept beside the package ------------------------------------------------------------------


def forget() -> None:
    """Clear the caches, as in a new process."""
    for cached in (identity._digest, identity._state, definitions.module_of, definitions.path_of):
        cached.cache_clear()


def test_a_digest_is_computed_once_until_a_module_changes(tmp_path, monkeypatch):
    root = package(tmp_path, **BASE)
    first = code_digest("hilsplat.a:g", root=root)
    forget()
    with monkeypatch.context() as patch:
        patch.setattr(identity, "_digest_of", None)  # a second process reads the stored digest
        assert code_digest("hilsplat.a:g", root=root) == first
    forget()
    (root / "b.py").write_text(BASE["b"].replace("ONE = 1", "ONE = 100"))
    changed = code_digest("hilsplat.a:g", root=root)
    assert changed != first
    forget()
    (kept,) = (root / "__pycache__").glob("identity.*.json")
    state = identity._read_state(root)
    for damaged in ("damaged", "[]", '{"state": 1, "digests": {}}', f'{{"state": "{state}", "digests": []}}'):
        kept.write_text(damaged)
        assert code_digest("hilsplat.a:g", root=root) == changed
        forget()
    kept.write_text(json.dumps({"state": state, "digests": {"hilsplat.a:g": 7}}))
    assert code_digest("hilsplat.a:g", root=root) == changed
    forget()


def test_a_read_only_package_has_a_digest(tmp_path):
    root = package(tmp_path, **BASE)
    (root / "__pycache__").write_text("no folder")
    other = package(tmp_path / "other", **BASE)
    assert code_digest("hilsplat.a:g", root=root) == code_digest("hilsplat.a:g", root=other)


def test_data_beside_a_module_count_as_its_code(copy, project):
    data = copy / "datasets/classes.json"
    data.write_text(data.read_text().replace("wall", "a wall", 1))
    found = changed(copy, project)
    assert "evaluate" in found and not {"masks", "clip", "semantic_tree", "field"} & found
