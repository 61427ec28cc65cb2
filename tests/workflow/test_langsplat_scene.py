"""A scene of LangSplat, with poses, Gaussians and features, needs two commands."""

import json
import os
import re
import sys
from pathlib import Path

import pandas as pd
import pytest

from hilsplat.base.artifacts import read_index
from tests.workflow.conftest import SCENE, Project


@pytest.fixture
def theirs(finished: Project, tmp_path: Path) -> Path:
    """The tiny scene's photographs with the outputs of 3DGS and LangSplat, and labels as in LERF-OVS."""
    own, folder = str(finished.root / SCENE), tmp_path / "their scene"
    export = ("export", own, "--as")
    finished.hilsplat(*export, "langsplat", "--out", str(folder), folder=tmp_path)
    finished.hilsplat(*export, "labels", "--out", str(folder / "label"), folder=tmp_path)
    for number, path in enumerate(sorted((folder / "label").glob("*.json"))):
        if number >= 3:  # few views are labelled, and scoring takes time
            path.unlink()
            continue
        labels = json.loads(path.read_text())
        for thing in labels["objects"]:
            del thing["level"], thing["parent"], thing["origin"]  # ours: LERF-OVS has none
        path.write_text(json.dumps(labels))
    trained = folder / "output/tiny/point_cloud/iteration_30000"
    trained.mkdir(parents=True)
    (folder / "point_cloud.ply").rename(trained / "point_cloud.ply")
    (folder / "output/tiny/chkpnt30000.pth").write_bytes(b"a pickle")
    return folder


def test_a_scene_of_langsplat_answers_after_two_commands(
    theirs: Path, finished: Project, plain: Project
) -> None:
    project = plain
    said = project.hilsplat("new", "theirs", str(theirs))
    assert "iteration_30000/point_cloud.ply" in said and "language_features" in said
    assert "chkpnt30000.pth" in said
    told = project.run(sys.executable, "-m", "hilsplat", "run", "theirs", "--", "--cores", "2").stderr
    means = (project.root / "results/photos/theirs/scores.csv").read_text()
    for answerer in ("hilsplat (tree)", "hilsplat (field)", "LangSplat (ours)"):
        assert re.search(rf"{re.escape(answerer)} +[0-9.]+ +[0-9.]+", told), told
        assert f"\n{answerer}," in means
    results = project.root / "results/photos/theirs"
    assert read_index(results / "default/masks")["segmenter"] == "langsplat"
    assert json.loads((results / "gaussians/report.json").read_text())["origin"]["kind"] == "imported"
    assert (results / "default/field.safetensors").is_file()
    for variant in ("default", "langsplat"):
        scores = pd.read_csv(results / variant / "scores.csv")
        field = scores[(scores["protocol"] == "lerf/langsplat@3") & (scores["metric"] == "iou")]
        assert field["value"].mean() > 0.1, variant
    assert (project.root / "results/figures/photos/theirs/panel.webp").is_file()
    before = finished.hilsplat("query", "synthetic/tiny", "mug", "--out", str(project.root / "a"))
    after = project.hilsplat("query", "photos/theirs", "mug", "--out", str(project.root / "b"))
    level = [text.split("\n")[2].split()[1] for text in (before, after)]
    assert level[0] == level[1]
    # a rerun of an early stage keeps the imported masks
    printed = project.hilsplat("run", "theirs", "--", "-n", "--forcerun", "poses")
    assert "\nrule imported_masks: photos/theirs/default: Input files updated" in printed
    assert "rule masks:" not in printed and "Building DAG" not in printed and "resources:" not in printed
    # other labels, Gaussians and features rerun their stages, even if they are older
    labels = sorted((project.root / "annotated/photos/theirs").glob("*.json"))[0]
    replace_by_older(labels, labels.read_bytes() + b"\n")
    printed = project.hilsplat("run", "theirs", "--", "-n")
    assert (
        "rule evaluate:" in printed
        and "rule imported_masks:" not in printed
        and "rule gaussians:" not in printed
    )
    ply = theirs / "output/tiny/point_cloud/iteration_30000/point_cloud.ply"
    features = sorted((theirs / "language_features").glob("*_s.npy"))[0]
    for path in (ply, features):
        content = path.read_bytes()
        replace_by_older(path, content[:-1] + bytes([content[-1] ^ 1]))
    printed = project.hilsplat("run", "theirs", "--", "-n")
    assert "rule imported_masks:" in printed and "rule gaussians:" in printed and "rule poses:" not in printed


def replace_by_older(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    os.utime(path, (0, 0))
