"""`hilsplat.open` and the commands that query a finished scene, from other folders and after a move."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hilsplat
from hilsplat.annotate.labels import Label, label_path, write_labels
from hilsplat.base.artifacts import read_index, read_npy
from hilsplat.base.errors import ModelError, SettingsError
from hilsplat.cli.user_commands import scene_folder
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate.figures.comparison import open_variants
from hilsplat.models.folder import open_model_folder
from hilsplat.query.answer import answer
from hilsplat.query.names import NO_FILE, NodeNames
from hilsplat.scene.finished import FinishedScene
from tests.unit.artifact_changes import change_index, write_record
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, SCENE, WIDTH, region_mask


@pytest.fixture
def desk(desk_project) -> Path:
    return desk_project


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    """Another working directory."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def copied(desk, elsewhere) -> Path:
    """Relative path of a scene in a copy of the project, to change."""
    shutil.copytree(desk, "copy")
    return Path("copy") / SCENE


COMMAND = "from hilsplat.cli.main import main; main()"


def run_python(project: Path, code: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run code with the package of this checkout in the present working directory."""
    command = [sys.executable, "-c", code, *words]
    environment = {**os.environ, "PYTHONPATH": str(project)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)


def run_command(project: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the real `hilsplat`, which must succeed."""
    done = run_python(project, COMMAND, *words)
    assert done.returncode == 0, done.stderr
    return done


def test_importing_the_package_loads_nothing_heavy(project):
    code = "import hilsplat, sys; hilsplat.Level; hilsplat.HilsplatError; print(sorted(sys.modules))"
    loaded = set(re.findall(r"'(\w+)'", run_python(project, code).stdout))
    assert "hilsplat" in loaded
    assert not loaded & {"torch", "numba", "numpy", "snakemake", "onnxruntime", "matplotlib"}


def test_public_names_are_the_types_that_open_returns(desk):
    scene = hilsplat.open(desk / SCENE)
    (hit,) = scene.query("mug")
    assert isinstance(scene, hilsplat.LanguageScene)
    assert isinstance(hit, hilsplat.Hit)
    assert isinstance(hit.level, hilsplat.Level)
    assert isinstance(scene.query("unicorn")[0].doubts[0], hilsplat.Doubt)
    assert set(hilsplat.__all__) == {"open", "LanguageScene", "Hit", "Doubt", "Level", "HilsplatError"}
    with pytest.raises(AttributeError, match="no attribute 'shut'"):
        hilsplat.shut  # noqa: B018


def test_a_hit_has_its_gaussians_and_its_pixels(desk):
    scene = hilsplat.open(desk / SCENE)
    (hit,) = scene.query("mug > handle > rim")
    true = np.flatnonzero(region_mask("rim")[:, :WIDTH])
    # a pixel's blur reaches the Gaussians next to the border
    assert set(true) <= set(hit.gaussians)
    assert len(hit.gaussians) <= 1.4 * len(true)
    view = scene.views[-1]
    shown = hit.mask(view)
    expected = region_mask("rim", NUM_VIEWS - 1)
    assert shown.shape == expected.shape == (HEIGHT, WIDTH + NUM_VIEWS)
    assert (shown & expected).sum() / (shown | expected).sum() > 0.7
    with pytest.raises(SettingsError, match=r"photos/desk has no view 'x\.png'"):
        hit.mask("x.png")


def test_a_moved_results_folder_finds_its_clip_by_digest(desk, elsewhere):
    shutil.copytree(desk / "results", elsewhere / "archive/outcomes")
    shutil.copytree(desk / "models/colours", elsewhere / "archive/models/renamed")
    hits = hilsplat.open("archive/outcomes/photos/desk").query("mug")
    assert hits == hilsplat.open(desk / SCENE).query("mug")
    shutil.rmtree("archive/models")
    shutil.copytree(desk / "models/colours", elsewhere / "models/group/renamed")  # of the working directory
    assert hilsplat.open("archive/outcomes/photos/desk").query("mug") == hits


def test_another_clip_is_refused(copied):
    described = Path("copy/models/colours/preprocessor_config.json")
    described.write_text(described.read_text().replace('"image_std": [1, 1, 1]', '"image_std": [2, 1, 1]'))
    with pytest.raises(ModelError, match="the CLIP model that embedded the masks in") as caught:
        hilsplat.open(copied)
    message = str(caught.value)
    assert read_index(copied / "default/clip")["model_sha256"][:12] in message
    assert re.search(r"copy/models/colours with digest [0-9a-f]{12}", message)
    assert "models/clip-tiny with digest" in message  # what the checkout has
    assert "rerun the clip stage" in message


def test_a_missing_clip_is_reported_with_the_searched_folders(desk, elsewhere, monkeypatch):
    monkeypatch.setattr("hilsplat.embed.clip.INSTALLED", elsewhere)
    shutil.copytree(desk / SCENE, elsewhere / "desk")
    (elsewhere / "models").mkdir()
    with pytest.raises(ModelError, match=rf"no CLIP model at models/colours or in {elsewhere}/models"):
        hilsplat.open("desk")


def test_the_embedded_clip_warns_that_it_does_not_know_photographs(copied, caplog):
    assert hilsplat.open(copied).caution == ""  # colours is a CLIP of its own
    assert "meaningless" not in caplog.text
    card = Path("copy/models/colours/config.json")
    card.write_text(json.dumps({**json.loads(card.read_text()), "world_only": True}))
    change_index(copied / "default/clip", model_sha256=open_model_folder(card.parent).digest)
    scene = hilsplat.open(copied)
    caution = scene.caution
    assert caution.startswith("colours was trained only on the synthetic world: its answers")
    assert f"photos/desk: {caution}" in caplog.text
    assert caution in next(answer(copied, "mug")) and "hilsplat models get" in caution
    # CLIP isn't used for a name that the user gave
    named = replace(scene, names=NodeNames({0: "the frog"}))
    assert named.caution_about("The frog") == "" and named.caution_about("the frog > nose") == caution
    # the embedded models were trained on synthetic scenes
    for images, expected in ((str(copied / "scene"), caution), ("results/synthetic/x/world/images", "")):
        write_record(copied / "scene", inputs={"images": {"path": images}})
        assert hilsplat.open(copied).caution == expected


def test_a_copy_without_recorded_settings_warns(desk, elsewhere, caplog):
    shutil.copytree(desk / SCENE, elsewhere / "desk")
    shutil.copytree(desk / "models", elsewhere / "models")
    hilsplat.open("desk")
    assert "using the defaults" not in caplog.text
    (elsewhere / "desk/default/scores.csv.provenance.json").unlink()
    hilsplat.open("desk")
    assert "using the defaults" in caplog.text


def test_the_example_of_the_docs_runs(desk, project, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    blocks = re.findall(r"```python\n(.*?)```", (project / "docs/python.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    names: dict = {}
    for block in blocks:
        exec(compile(block, "docs/python.md", "exec"), names)
    assert names["mask"].shape == names["photograph"].shape[:2]
    assert names["best"].keys() == {"desk"}
    printed = capsys.readouterr().out
    assert "'unicorn' may not be in the scene: the model's vocabulary lacks 'unicorn'" in printed
    assert "has no view 'no such view'" in printed


# -- commands -----------------------------------------------------------------------------------------


def test_query_takes_a_path_from_any_folder(desk, elsewhere, project):
    asked = run_command(project, "query", str(desk / SCENE), "mug > handle", "--out", "answer")
    lines = asked.stdout.splitlines()
    assert lines[0] == "1 answer to 'mug > handle' in photos/desk; lengths in scene units"
    assert lines[2].split()[1] == "part"
    assert "doubtful" not in asked.stdout
    assert lines[-1] == "wrote answer/panel.png and selection.ply"
    for name in ("panel.png", "selection.ply"):
        assert (elsewhere / "answer" / name).stat().st_size > 1000


def test_a_scene_is_found_by_its_name_alone(desk, tmp_path):
    results = desk / "results"
    assert scene_folder("desk", results) == scene_folder("photos/desk", results) == results / "photos/desk"
    assert scene_folder(str(results / "photos/desk"), Path("elsewhere")) == results / "photos/desk"
    for dataset in ("photos", "synthetic"):
        (tmp_path / dataset / "desk/scene").mkdir(parents=True)
    with pytest.raises(SettingsError, match=r"several scenes(.|\n)*photos/desk, synthetic/desk"):
        scene_folder("desk", tmp_path)


def test_export_writes_the_tree_to_any_folder(desk, elsewhere, project):
    done = run_command(project, "export", str(desk / SCENE), "--out", "tree")
    assert "2 whole, 2 part, 1 subpart" in done.stdout
    nodes = json.loads((elsewhere / "tree/tree.json").read_text())["nodes"]
    assert [node["level"] for node in nodes] == ["whole", "whole", "part", "part", "subpart"]
    assert (elsewhere / "tree/tree.png").is_file()
    assert (elsewhere / "tree/tree.ply").stat().st_size > (desk / SCENE / "gaussians.ply").stat().st_size


def test_an_export_does_not_replace_a_folder_with_files(desk, elsewhere, project):
    (elsewhere / "mine").mkdir()
    (elsewhere / "mine/thesis.txt").write_text("years of work")
    done = run_python(project, COMMAND, "export", str(desk / SCENE), "--as", "colmap", "--out", "mine")
    assert done.returncode == 1 and "--out mine exists" in done.stderr
    assert (elsewhere / "mine/thesis.txt").read_text() == "years of work"


def test_labels_exported_in_the_layout_of_lerf_are_read_back(copied, elsewhere, project):
    view, size_hw = "000.png", (HEIGHT, WIDTH + NUM_VIEWS)
    ring = [(1, 1), (5, 1), (5, 4), (1, 4)]
    labels = [
        Label(id=3, level=1, text="mug", polygons=[ring, [(7, 1), (8, 1), (8, 2)]]),
        Label(id=9, level=2, parent=3, text="handle", polygons=[ring]),
    ]
    source = elsewhere / "annotated/photos/desk"
    write_labels(label_path(source, view), view, size_hw, labels, NO_FILE)
    done = run_command(project, "export", str(copied), "--as", "labels", "--data-root", ".")
    assert "labels of 1 views" in done.stdout
    out = copied / "export/labels"
    assert {path.name for path in out.iterdir()} == {view, f"{Path(view).stem}.json"}
    shutil.copytree(out, elsewhere / "back/annotated/photos/desk")
    before, after = (open_labelled("annotated/photos/desk", root) for root in (elsewhere, elsewhere / "back"))
    for one, other in zip(before.views[view], after.views[view], strict=True):
        assert (one.text, one.level, one.path) == (other.text, other.level, other.path)
        assert np.array_equal(one.mask(), other.mask())
        assert np.array_equal(one.boxes(), other.boxes())


def test_exported_langsplat_files_are_read_back(desk, elsewhere, project):
    default = desk / SCENE / "default"
    run_command(project, "export", str(desk / SCENE), "--as", "langsplat", "--out", "theirs")
    written = {path.name for path in (elsewhere / "theirs").iterdir()}
    assert written == {"images", "sparse", "point_cloud.ply", "language_features"}
    shutil.move(elsewhere / "theirs/language_features", elsewhere)
    maps = read_npy(elsewhere / "language_features/000_s.npy")
    assert maps.shape == (4, HEIGHT, WIDTH + NUM_VIEWS)
    assert np.array_equal(maps[3] >= 0, region_mask("mug") | region_mask("book"))  # the fourth map: wholes
    model = json.dumps({"model": str(desk / "models/colours")})
    taken = ("--scene", str(desk / SCENE / "scene"), "--features", "language_features")
    run_command(project, "masks", *taken, "--out", "masks")
    run_command(project, "clip", *taken, "--masks", "masks", "--settings", model, "--out", "clip")
    for view in ("000.png", "004.png"):
        back, before = read_npy(Path(f"clip/{view}.npy")), read_npy(default / f"clip/{view}.npy")
        rows = [np.abs(before.astype(float) - vector).max(axis=1).argmin() for vector in back.astype(float)]
        assert sorted(rows) == list(range(len(before)))
        assert before[rows] == pytest.approx(back, abs=1e-3)


def test_variants_open_shared_artifacts_once(copied):
    (copied / "omega-2").mkdir()
    for part in copied.glob("default/field.safetensors*"):
        shutil.copy(part, copied / "omega-2")
    scenes = open_variants(copied, ["default", "omega-2"], 1)
    first, second = scenes["default"], scenes["omega-2"]
    assert first.gaussians is second.gaussians
    assert first.tree is second.tree
    assert first.scene is second.scene
    assert first.language is not second.language


def test_key_views_are_queried_until_the_vectors_of_all_views_exist(desk, tmp_path, caplog):
    growing = tmp_path / "photos/desk"
    shutil.copytree(desk / SCENE, growing, ignore=shutil.ignore_patterns("field.safetensors*", "scores.csv*"))
    key = growing / "key-views"
    key.mkdir()
    for part in ("clip", "semantic_tree", "masks"):
        (growing / "default" / part).rename(key / part)
    parts = FinishedScene.locate(growing).parts
    expected = [key / name for name in ("clip", "semantic_tree", "masks")]
    assert [parts.clip, parts.semantic_tree, parts.masks] == expected and parts.field is None
    assert re.search(r"photos/desk uses \d+ of \d+ photographs until the run ends", caplog.text)
