"""Compiled loops are in kernel modules, whose files alone decide whether cached machine code is valid."""

import ast
from pathlib import Path

import pytest

PACKAGES = ("hilsplat", "hilsplat_world")
OURS = ("cpusplat", *PACKAGES)


def imports_of(path: Path) -> set[str]:
    """Modules that a module imports from our packages, with the names imported from each."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
    return {node.module for node in nodes if node.module.partition(".")[0] in OURS}


@pytest.mark.parametrize("package", PACKAGES)
def test_only_kernel_modules_compile_loops_and_they_import_no_other_code(project, package):
    modules = {path: imports_of(path) for path in (project / package).rglob("*.py")}
    kernels = {path for path in modules if path.stem.endswith("kernels")}
    assert len(kernels) > 1
    assert {path for path, imports in modules.items() if "cpusplat.compiled" in imports} <= kernels
    for path in kernels:
        for name in modules[path]:
            assert name.startswith("cpusplat.") or name.endswith("kernels"), f"{path} imports {name}"
