"""Packages of others add a stage with its rule, and a data set, by entry points alone."""

import csv
import json
import sys

import numpy as np

from hilsplat.base.images import write_png
from tests.workflow.conftest import Project

FILES = {
    "desk_plugin/__init__.py": "from pathlib import Path\n\nRULES = Path(__file__).with_name('count.smk')\n",
    "desk_plugin/stages.py": '''
from hilsplat.stage import PathIn, PathOut, Registry

PIPELINE = Registry()


@PIPELINE.stage(file="count.txt")
def count(semantic_tree: PathIn, out: PathOut) -> None:
    """Count the nodes of a semantic tree."""
    from desk_plugin.counting import run_count

    run_count(semantic_tree, out)
''',
    "desk_plugin/counting.py": '''
from hilsplat.base.artifacts import write_text
from hilsplat.semantic_tree.tree import SemanticTree


def run_count(semantic_tree, out):
    """Write the number of nodes."""
    write_text(out, f"{len(SemanticTree.load(semantic_tree).level)} nodes")
''',
    "desk_plugin/count.smk": """
use rule stage as count with:
    input:
        **PLAN.inputs("count"),
    output:
        out="<results>/{dataset}/{scene}/{variant}/count.txt",
    log:
        PLAN.log("count"),
    benchmark:
        PLAN.benchmark("count")
    threads: 1
    resources:
        **RESOURCES.of("count"),
    params:
        **PLAN.params("count"),
""",
    "desk_plugin/labels.py": """
from hilsplat.base.images import read_image
from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene, image_size_hw, images_by_view


def open_scene(root, scene):
    def region(path):
        return LabelledRegion(path.stem, image_size_hw(path), lambda: read_image(path)[..., 0] > 128)

    folders = sorted((root / scene / "labels").iterdir())
    views = {f"{folder.name}.png": tuple(map(region, sorted(folder.iterdir()))) for folder in folders}
    return LabelledScene("desk", scene, images_by_view(root / scene / "images"), None, views)


DESK = Dataset(
    name="desk", title="Desk", labels="images", scenes=("mine",),
    licence="yours", terms="None.", citation="You",
    layout="desk/<scene>/images, desk/<scene>/labels/<view>/<text>.png",
    required=lambda scene: (f"{scene}/images", f"{scene}/labels"),
    open=open_scene,
    label_places=lambda scene: (f"{scene}/labels/**/*",),
)
""",
    "desk_plugin-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: desk-plugin\nVersion: 1.0\n",
    "desk_plugin-1.0.dist-info/entry_points.txt": """
[hilsplat.stages]
desk = desk_plugin.stages:PIPELINE
[hilsplat.rules]
desk = desk_plugin:RULES
[hilsplat.datasets]
desk = desk_plugin.labels:DESK
""",
}


class PluginProject(Project):
    """A project beside an installed plugin."""

    def environment(self, **more: str) -> dict[str, str]:
        found = super().environment(**more)
        return found | {"PYTHONPATH": f"{found['PYTHONPATH']}:{self.root / 'site'}"}


def with_plugin(project: Project) -> PluginProject:
    for name, text in FILES.items():
        path = project.root / "site" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return PluginProject(project.root)


def test_a_stage_is_a_command_a_rule_and_a_digest(copy_of_finished):
    project = with_plugin(copy_of_finished)
    target = "results/synthetic/tiny/default/count.txt"
    project.snakemake(target)
    number = int((project.root / target).read_text().split()[0])
    assert number > 3
    record = json.loads((project.root / f"{target}.provenance.json").read_text())
    assert record["stage"] == "count" and record["inputs"]["semantic_tree"]["sha256"]
    assert (
        "Count the nodes of a semantic tree"
        in project.run(sys.executable, "-m", "hilsplat", "count", "--help").stdout
    )
    project.edit("site/desk_plugin/counting.py", "Write the number", "Write down the number")
    assert project.planned(target) == set(), "a docstring changes nothing"
    project.edit("site/desk_plugin/counting.py", " nodes", " nodes in all")
    assert project.planned(target) == {"count"}


def test_a_data_set_is_listed_read_and_scored(plain, tmp_path):
    project = with_plugin(plain)
    scene, square = tmp_path / "data/desk/mine", np.zeros((40, 60, 3), np.uint8)
    square[10:30, 20:40] = 255
    (scene / "images").mkdir(parents=True)
    (scene / "labels/0").mkdir(parents=True)
    write_png(scene / "images/0.png", square)
    write_png(scene / "labels/0/mug.png", square)
    (tmp_path / "masks/0").mkdir(parents=True)
    write_png(tmp_path / "masks/0/mug.png", square)

    def hilsplat(*words: str) -> str:
        return project.run(sys.executable, "-m", "hilsplat", *words).stdout

    root = ("--data-root", str(tmp_path / "data"))
    assert "desk: Desk, labels on images" in hilsplat("datasets", "list", *root)
    assert "desk/mine:" in hilsplat("datasets", "check", "desk", *root)
    out = tmp_path / "scores.csv"
    words = ("--method", "mine", "--labels", "desk/mine", "--out", str(out))
    hilsplat("evaluate-files", str(tmp_path / "masks"), *words, *root)
    with out.open() as stream:
        rows = list(csv.DictReader(stream))
    assert rows and {row["dataset"] for row in rows} == {"desk"}
    assert all(float(row["value"]) == 1 for row in rows if row["metric"] == "miou")
