"""Published data sets in the workflow: absent ones are reported, labels are inputs of evaluation alone."""

import re
import sys
from collections.abc import Iterator

import pytest

from hilsplat.evaluate.tables.build import TABLES
from tests.workflow.conftest import copy_project

LABELS = ("data/lerf_ovs/label/figurines/frame_00041.json", "data/3d_ovs/bed/segmentations/00/banana.png")
SCAN = "data/scannet/scans/scene0000_00"
OTHER_FILES = (
    "data/lerf_ovs/figurines/images/frame_00041.jpg",
    "data/lerf_ovs/figurines/sparse/0/images.bin",
    "data/3d_ovs/bed/images/00.jpg",
    "data/3d_ovs/bed/sparse/0/images.bin",
    "data/3d_ovs/bed/segmentations/classes.txt",
    "data/replica/replica/room_0/habitat/mesh_semantic.ply",
    *(f"{SCAN}/{name}" for name in ("color/0.jpg", "pose/0.txt", "intrinsic/intrinsic_color.txt")),
    *(f"{SCAN}/scene0000_00_vh_clean_2.{end}" for end in ("ply", "labels.ply", "0.010000.segs.json")),
    f"{SCAN}/scene0000_00.aggregation.json",
)


@pytest.fixture(scope="module")
def planned(project, tmp_path_factory) -> str:
    """Dry run of the paper's configuration with one scene of LERF, one of 3D-OVS and one scan present."""
    copy = copy_project(project, tmp_path_factory.mktemp("data") / "project", results=False)
    for path in (*LABELS, *OTHER_FILES):
        (copy.root / path).parent.mkdir(parents=True, exist_ok=True)
        (copy.root / path).touch()
    command = (sys.executable, "-m", "hilsplat", "run", "-n", "--cores", "2", "--config", "paper")
    models = {"HILSPLAT_MODELS": str(copy.root / "none")}  # the estimate needs none
    result = copy.run(*command, "--verbose", "--", "-p", "--config", "data_root=data", **models)
    return result.stdout + result.stderr


def blocks(planned: str) -> Iterator[tuple[str, str]]:
    """Yield the rule of each job, and the dry run's output about the job."""
    for part in re.split(r"^(?=(?:local)?rule )", planned, flags=re.M):
        if found := re.match(r"(?:local)?rule (\w+):", part):
            yield found[1], part


@pytest.mark.parametrize("label", LABELS)
def test_labels_are_inputs_of_evaluation_and_figures_only(planned, label):
    readers = {rule for rule, text in blocks(planned) if label in text.partition("output:")[0]}
    assert readers == {"evaluate", "figures", "comparison"}


def test_a_scan_is_exported_before_its_poses_are_imported(planned):
    exported = [text for rule, text in blocks(planned) if rule == "source"]
    assert len(exported) == 1
    assert "color/0.jpg" in exported[0]
    assert "aggregation.json" not in exported[0]


def test_absent_scenes_are_listed_with_the_reason(planned):
    assert "lerf (ramen) is skipped: scene ramen of LERF-OVS is incomplete" in planned
    assert re.search(r"replica \(office_0, .* and \d more\) is skipped: .*in the wrong place", planned)
    assert re.search(r" table replica .*--absent 'replica \(", planned)


def test_missing_models_are_named_and_their_costs_are_known(planned):
    assert "model folder models/clip-vit-b-16-laion2b is missing" in planned
    assert "fetch it: hilsplat models get clip-vit-b-16-laion2b" in planned
    hours = planned.partition("Estimate for this run:\n")[2].splitlines()[1].split()[-2]
    assert float(hours) > 0.1, "SAM ViT-H takes minutes per photograph"


def test_every_stage_and_table_is_planned(planned):
    rules = [rule for rule, _ in blocks(planned)]
    stages = {"poses", "gaussians", "masks", "coverage_tree", "clip", "contributions", "field", "figures"}
    assert stages <= set(rules) and rules.count("table") == len(TABLES)


def test_a_dry_run_ends_with_the_estimate_table(planned):
    table = planned.partition("Estimate for this run:\n")[2].splitlines()
    assert table[0].split() == ["scenes", "jobs", "disk", "memory", "hours,", "2", "cores", "hours,", "GPU"]
    assert [row.split()[0] for row in table[1:6]] == ["3d_ovs", "lerf", "scannet", "tables", "all"]
    counted = re.search(r"^total +(\d+)$", planned, re.M)
    assert table[5].split()[1:3] == ["3", counted[1]]
