"""The notebooks of the documentation run, and their saved outputs are of the present cells.

To run them again and save their outputs: python -m tests.unit.test_notebooks
"""

import os
import tempfile
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.conftest import PROJECT

NOTEBOOKS = sorted((PROJECT / "docs/notebooks").glob("*.ipynb"))
MOST_BYTES = 400_000


def executed(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Run a notebook in an empty folder, on the code of this checkout."""
    notebook = nbformat.read(path, as_version=4)
    paths = [str(PROJECT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HILSPLAT_MODELS": "models"}
    environment.pop("MPLBACKEND", None)  # the kernel's own shows pictures in the notebook
    client = NotebookClient(
        notebook,
        timeout=600,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        record_timing=False,
        coalesce_streams=True,  # the kernel sends what is printed in pieces, cut by time
    )
    client.execute(env=environment)
    notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return notebook


def outputs(notebook: nbformat.NotebookNode) -> list[list[str]]:
    """Kinds of each code cell's outputs: names of streams, and types of data."""
    return [
        [" ".join(sorted(output.get("data", [output.get("name", "")]))) for output in cell.outputs]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def test_saved_notebooks_are_small_and_show_pictures():
    assert [path.stem for path in NOTEBOOKS] == ["scoring", "tour"]
    assert sum(path.stat().st_size for path in NOTEBOOKS) < MOST_BYTES
    for path in NOTEBOOKS:
        kinds = [kind for of_cell in outputs(nbformat.read(path, as_version=4)) for kind in of_cell]
        assert any("image/png" in kind for kind in kinds), path.name
        assert "stderr" not in kinds, path.name
        assert "/tmp/" not in path.read_text() and "/work/" not in path.read_text(), path.name


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path):
    assert outputs(executed(path, tmp_path)) == outputs(nbformat.read(path, as_version=4))


if __name__ == "__main__":
    for path in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            nbformat.write(executed(path, Path(folder)), path)
