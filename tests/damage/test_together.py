"""Twenty commands at once in one project: nothing is lost, and none disturbs another."""

import subprocess
import sys
from pathlib import Path

from hilsplat.query.names import read_names
from hilsplat.scene.sheet import read_sheet
from tests.unit.annotate.label_files import read_labels
from tests.unit.finished_desk import NUM_VIEWS, pack_photographs

NAME = """
import sys
from pathlib import Path
from hilsplat.query.names import read_names, write_names
from hilsplat.web.file_changes import StaleFileError
scene, node = Path("results/photos/desk"), int(sys.argv[1])
while True:
    known = read_names(scene, scene / "default/semantic_tree")
    names = {**known.of_node, node: f"thing {node}"}
    try:
        write_names(scene, scene / "default/semantic_tree", names, 5, known.version)
        break
    except StaleFileError:
        pass
"""

ANNOTATE = """
import sys
from pathlib import Path
from hilsplat.annotate.labels import Label, label_path, write_labels
from hilsplat.web.file_changes import StaleFileError, version_of
from tests.unit.annotate.label_files import read_labels
number, size = int(sys.argv[1]), (24, 42)
path = label_path(Path("annotated/photos/desk"), "000.png")
while True:
    version = version_of(path)
    ring = [(1, 1), (15, 1), (15, 20), (1, 20)]
    label = Label(id=number, level=1, text=f"thing {number}", polygons=[ring])
    try:
        write_labels(path, "000.png", size, [*read_labels(path), label], version)
        break
    except StaleFileError:
        pass
"""


def test_twenty_commands_at_once_lose_nothing(own_desk: Path) -> None:
    project = own_desk.parents[2]
    pack_photographs(project)
    hilsplat = ["-P", "-m", "hilsplat"]
    commands = [[*hilsplat, "new", f"scene-{number}", "photos.zip"] for number in range(5)]
    commands += [[*hilsplat, "new", "twin", "photos.zip"]] * 2
    commands += [["-c", NAME, str(number)] for number in range(3)]
    commands += [["-c", ANNOTATE, str(number)] for number in (1, 2, 3)]
    commands += [[*hilsplat, "query", "photos/desk", "mug", "--out", f"answers/{n}"] for n in range(3)]
    commands += [
        [*hilsplat, "export", "photos/desk", "--as", "ply", "--out", f"exported/{n}"] for n in range(2)
    ]
    commands += [[*hilsplat, "cache", "--folder", "results/.cache", "prune", "--days", "0"]] * 2
    assert len(commands) == 20
    how = {"cwd": project, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    running = [subprocess.Popen([sys.executable, *words], text=True, **how) for words in commands]
    said = [process.communicate(timeout=300)[0] for process in running]
    failed = [number for number, process in enumerate(running) if process.returncode]
    assert len(failed) == 1 and commands[failed[0]][4] == "twin", [said[number] for number in failed]
    assert "photos/twin is already in" in said[failed[0]]
    rows = [row.name for row in read_sheet(project / "config/scenes.tsv") if row.dataset == "photos"]
    assert sorted(rows) == [*(f"photos/scene-{number}" for number in range(5)), "photos/twin"]
    assert all(len(list((project / row).glob("*.png"))) == NUM_VIEWS for row in rows)
    names = read_names(own_desk, own_desk / "default/semantic_tree").of_node
    assert names == {number: f"thing {number}" for number in range(3)}
    labels = read_labels(project / "annotated/photos/desk/000.json")
    assert sorted(label.text for label in labels) == ["thing 1", "thing 2", "thing 3"]
    for folder, file in (("answers", "selection.ply"), ("exported", "point_cloud.ply")):
        assert len({path.read_bytes() for path in (project / folder).glob(f"*/{file}")}) == 1
    assert not list(project.rglob(".writing-*"))
