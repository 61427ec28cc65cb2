"""`hilsplat.open_scene` and the commands that query a finished scene, from other folders and after a move."""

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
from plyfile import PlyData

import hilsplat
from hilsplat.annotate.labels import Label, label_path, write_labels
from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import ArtifactError, ModelError, SettingsError
from hilsplat.base.images import read_mask
from hilsplat.cli.main import app
from hilsplat.cli.user_commands import scene_folder
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate.figures.comparison import open_variant
from hilsplat.models.folder import open_model_folder
from hilsplat.query.answer import answer
from hilsplat.query.names import NO_FILE, NodeNames
from hilsplat.query.scene_views import Opened
from hilsplat.scene.finished import FinishedScene
from hilsplat.splat.ply import load_ply
from tests.unit.artifact_changes import change_index, loosen, write_record
from tests.unit.finished_desk import HEIGHT, NUM_VIEWS, SCENE, WIDTH
from tests.unit.splat.spz_reader import decoded


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> Path:
    """Another working directory."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def copied(desk_project, elsewhere) -> Path:
    """Relative path of a scene in a copy of the project, to change."""
    shutil.copytree(desk_project, "copy")
    return Path("copy") / SCENE


def run(*words: str) -> None:
    """Run a command in this process."""
    app(words, standalone_mode=False)


def test_importing_the_package_loads_nothing_heavy(project):
    code = "import hilsplat, sys; hilsplat.Level; hilsplat.HilsplatError; print(sorted(sys.modules))"
    environment = {**os.environ, "PYTHONPATH": str(project)}
    printed = subprocess.check_output([sys.executable, "-c", code], text=True, env=environment)
    loaded = set(re.findall(r"'(\w+)'", printed))
    assert "hilsplat" in loaded
    assert not loaded & {"torch", "numba", "numpy", "snakemake", "onnxruntime", "matplotlib"}


def test_public_names_are_the_types_that_open_returns(desk, named_desk):
    scene, scenes = hilsplat.open_scene(desk), hilsplat.open_scenes(named_desk.parents[1])
    (hit, *_), (scene_hit,) = scene.query("unicorn"), scenes.query("unicorn")
    made = (scene, hit, hit.level, hit.doubts[0], scenes, scene_hit, scene.nodes[0], scene.gaussians)
    made += (scene.scene, scene.camera("000.png"), scene.render("000.png"))
    assert {type(each).__name__ for each in made} <= set(hilsplat.__all__)
    assert all(getattr(hilsplat, name) for name in hilsplat.__all__)
    assert dir(hilsplat) == sorted(hilsplat.__all__)
    assert np.abs(255 * scene.render("000.png").colours - scene.views.image("000.png")).mean() < 40
    with pytest.raises(AttributeError, match="no attribute 'shut'"):
        hilsplat.shut  # noqa: B018


def test_a_moved_results_folder_finds_its_clip_by_digest(desk, desk_project, elsewhere):
    shutil.copytree(desk_project / "results", elsewhere / "archive/outcomes")
    shutil.copytree(desk_project / "models/colours", elsewhere / "archive/models/renamed")
    hits = hilsplat.open_scene("archive/outcomes/photos/desk").query("mug")
    assert hits == hilsplat.open_scene(desk).query("mug")
    shutil.rmtree("archive/models")
    shutil.copytree(desk_project / "models/colours", "models/group/renamed")  # of the working directory
    assert hilsplat.open_scene("archive/outcomes/photos/desk").query("mug") == hits


def test_another_clip_is_refused(copied):
    described = Path("copy/models/colours/preprocessor_config.json")
    described.write_text(described.read_text().replace('"image_std": [1, 1, 1]', '"image_std": [2, 1, 1]'))
    with pytest.raises(ModelError, match="the CLIP model that embedded the masks in") as caught:
        hilsplat.open_scene(copied)
    message = str(caught.value)
    assert read_index(copied / "default/clip")["model_sha256"][:12] in message
    assert re.search(r"copy/models/colours with digest [0-9a-f]{12}", message)
    assert "models/clip-tiny with digest" in message  # what the checkout has
    assert "rerun the clip stage" in message


def test_a_missing_clip_is_reported_with_the_searched_folders(desk, elsewhere, monkeypatch):
    monkeypatch.setattr("hilsplat.embed.clip.INSTALLED", elsewhere)
    shutil.copytree(desk, elsewhere / "desk")
    (elsewhere / "models").mkdir()
    with pytest.raises(ModelError, match=rf"no CLIP model at models/colours or in {elsewhere}/models"):
        hilsplat.open_scene("desk")


def test_the_embedded_clip_warns_that_it_does_not_know_photographs(copied, caplog):
    assert hilsplat.open_scene(copied).caution == ""  # colours is a CLIP of its own
    assert "meaningless" not in caplog.text
    card = Path("copy/models/colours/config.json")
    card.write_text(json.dumps({**json.loads(card.read_text()), "world_only": True}))
    change_index(copied / "default/clip", model_sha256=open_model_folder(card.parent).digest)
    scene = hilsplat.open_scene(copied)
    caution = scene.caution
    assert caution.startswith("colours was trained only on the synthetic world: its answers")
    assert f"photos/desk: {caution}" in caplog.text
    assert caution in next(answer(copied, "mug")) and "hilsplat models get" in caution
    # CLIP isn't used for a name that the user gave
    named = replace(scene, names=NodeNames({0: "the frog"}))
    assert named.caution_about("The frog") == "" and named.caution_about("the frog > nose") == caution
    # the embedded models were trained on synthetic scenes
    photographs = {"path": "of/the/world/images", "files": {"of/the/world/images/1.jpg": "0" * 64}}
    for images, expected in (
        ({"path": str(copied / "scene")}, caution),
        (photographs, caution),
        ({"path": "results/synthetic/x/world/images"}, ""),
    ):
        write_record(copied / "scene", inputs={"images": images})
        assert hilsplat.open_scene(copied).caution == expected


def test_the_example_of_the_docs_runs(named_desk, project, monkeypatch, capsys):
    monkeypatch.chdir(named_desk.parents[2])
    blocks = re.findall(r"```python\n(.*?)```", (project / "docs/python.md").read_text(), re.DOTALL)
    assert len(blocks) == 3
    names: dict = {"hilsplat": hilsplat}
    for block in blocks[1:]:  # tests/workflow/test_library.py runs the first
        exec(compile(block, "docs/python.md", "exec"), names)
    assert names["mask"].shape == names["photograph"].shape[:2]
    printed = capsys.readouterr().out
    assert "'unicorn' may not be in the scene: the model's vocabulary lacks 'unicorn'" in printed
    assert "has no view 'no such view'" in printed


# -- commands -----------------------------------------------------------------------------------------


def test_query_reports_the_answer_and_saves_its_masks_and_compressed_gaussians(desk, elsewhere, capsys):
    run("query", str(desk), "mug", ">", "handle", "--out", "answer", "--masks", "masks", "--spz")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "1 answer to 'mug > handle' in photos/desk; lengths in scene units"
    assert lines[2].split()[1] == "part"
    assert not any("doubtful" in line for line in lines)
    assert lines[-3:] == [
        "wrote answer/panel.png and selection.ply",
        "wrote answer/selection.spz",
        "wrote masks of 1 node to masks/<view>/<node>.png and coco.json",
    ]
    assert (elsewhere / "answer/panel.png").stat().st_size > 1000
    (hit,) = (scene := hilsplat.open_scene(desk)).query("mug > handle")
    for view in scene.views.names:
        saved = read_mask(elsewhere / "masks" / Path(view).stem / f"{hit.node}.png") > 0
        np.testing.assert_array_equal(saved, hit.mask(view))
    coco = json.loads((elsewhere / "masks/coco.json").read_text())
    assert [each["name"] for each in coco["categories"]] == ["mug > handle"]
    assert len(coco["annotations"]) == len(scene.views.names)
    found = {(each["node"], each["score"]) for each in coco["annotations"]}
    assert found == {(hit.node, round(hit.score, 4))}
    header = PlyData.read(elsewhere / "answer/selection.ply").comments
    assert header[0].startswith("source_from_scene ")
    assert header[1:] == ["label 1: mug > handle", f"label 1, node {hit.node}: ?, score {hit.score:.4f}"]
    compressed = elsewhere / "answer/selection.spz"
    assert len(decoded(compressed.read_bytes())) == len(hit.gaussians)
    with pytest.raises(ArtifactError, match="--masks masks exists"):
        run("query", str(desk), "mug", "--out", "answer", "--masks", "masks")
    run("query", str(desk), "book", "--out", "answer")  # replaces the compressed Gaussians, too
    assert len(decoded(compressed.read_bytes())) == len(scene.query("book")[0].gaussians)
    run("query", str(desk), "mug", "--threshold", "0.99", "--view", "000.png", "--out", "a")
    assert "or omit --view, or omit --threshold" in capsys.readouterr().out


def test_export_leaves_out_or_keeps_what_matches_a_query_or_a_node(desk, elsewhere, capsys):
    scene = hilsplat.open_scene(desk)
    (book,), (handle,) = scene.query("book"), scene.query("mug > handle")
    gone, kept = (scene.views.gaussians_of([hit.node]) for hit in (book, handle))

    def exported(*words: str) -> np.ndarray:
        run("export", str(desk), "--as", "ply", "--out", words[-1], *words[:-1])
        return load_ply(elsewhere / words[-1] / "point_cloud.ply").means

    found = exported("--without", "book", "rest")
    line = f"without 'book': node {book.node} (?, {book.score:.2f}), {len(gone)} Gaussians"
    assert line in capsys.readouterr().out
    np.testing.assert_array_equal(found, np.delete(scene.gaussians.means, gone, axis=0))
    found = exported("--only", "mug", "--only", str(book.node), "--without", str(handle.node), "some")
    mug = scene.views.gaussians_of([hit.node for hit in scene.query("mug")])
    np.testing.assert_array_equal(found, scene.gaussians.means[np.setdiff1d(np.union1d(mug, gone), kept)])
    exported("--without", "unicorn > rim", "doubtful")
    assert "doubtful: 'unicorn' may not be in the scene" in capsys.readouterr().out
    for words, message in (
        (("--as", "tree", "--without", "book"), "--without is for --as ply"),
        (("--as", "tree", "--clean"), "--clean is for --as ply"),
        (("--as", "ply", "--without", "99"), "node 99 does not exist"),
        (("--as", "ply", "--only", "book", "--without", "book"), "no Gaussian remains"),
    ):
        with pytest.raises(SettingsError, match=message):
            run("export", str(desk), *words, "--out", "refused")
    assert not (elsewhere / "refused").exists()


def test_a_clean_export_leaves_out_gaussians_of_no_node(copied, elsewhere, capsys):
    loosen(copied, np.arange(100, 140))
    (book,) = (scene := hilsplat.open_scene(copied)).query("book")
    run("export", str(copied), "--as", "ply", "--clean", "--without", str(book.node), "--out", "clean")
    assert "without 40 Gaussians of no node" in capsys.readouterr().out
    gone = np.union1d(scene.views.gaussians_of([book.node]), np.arange(100, 140))
    found = load_ply(elsewhere / "clean/point_cloud.ply").means
    np.testing.assert_array_equal(found, np.delete(scene.gaussians.means, gone, axis=0))


@pytest.mark.parametrize(
    ("command", "option", "purpose"),
    [
        *(
            (
                ("query", "DESK", "mug", "--all", *option.split()),
                option.split()[0],
                "one scene, without --all",
            )
            for option in ("--masks m", "--spz", "--out o", "--view 0", "--views 2", "--answerer tree")
        ),
        (("query", "DESK", "mug", "--json"), "--json", "--all"),
        (("query", "DESK", "mug", "--limit", "3"), "--limit", "--all"),
        (("export", "DESK", "--as", "colmap", "--variant", "nope"), "--variant", "--as tree, --as langsplat"),
        (("export", "DESK", "--as", "ply", "--variant", "nope"), "--variant", "--as tree, --as langsplat"),
        (("export", "DESK", "--as", "tree", "--data-root", "."), "--data-root", "--as labels"),
        (("models", "check", "--variant", "fp16"), "--variant", "one folder"),
        (("cache", "prune", "--stage", "masks"), "--stage", "--days or --max-mib"),
    ],
)
def test_options_without_effect_are_refused(desk, elsewhere, command, option, purpose):
    with pytest.raises(SettingsError, match=f"{option} is for {purpose}(.|\n)*fix +use {purpose}"):
        run(*(str(desk) if word == "DESK" else word for word in command))
    assert not list(elsewhere.iterdir()) and not (desk / "export").exists()


@pytest.mark.parametrize(
    "command", [("query", "mug"), ("view", "--no-browser"), ("annotate", "--no-browser")]
)
def test_a_variant_that_does_not_exist_is_refused(desk, elsewhere, command):
    with pytest.raises(ArtifactError, match=r"has no variant 'defalt'(.|\n)*did you mean 'default'"):
        run(command[0], str(desk), *command[1:], "--variant", "defalt")


def test_masks_do_not_replace_the_picture_of_their_answer(desk, elsewhere):
    for out, masks in (("a", "a"), ("a/b", "a"), ("a", "a/panel.png"), ("a/../c", "c")):
        with pytest.raises(SettingsError, match="would replace"):
            run("query", str(desk), "mug", "--out", out, "--masks", masks)
    assert not list(elsewhere.iterdir())
    run("query", str(desk), "mug", "--out", "a", "--masks", "a/masks")
    assert {path.name for path in Path("a").iterdir()} >= {"panel.png", "selection.ply", "masks"}


def test_a_scene_is_found_by_its_name_alone(desk_project, tmp_path, monkeypatch):
    results = desk_project / "results"
    assert scene_folder("desk", results) == scene_folder("photos/desk", results) == results / "photos/desk"
    assert scene_folder(str(results / "photos/desk"), Path("elsewhere")) == results / "photos/desk"
    (tmp_path / "lamp").mkdir()  # its photographs
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ArtifactError, match=r"results/lamp is missing(.|\n)*hilsplat run SCENE"):
        scene_folder("lamp", Path("results"))
    for dataset in ("photos", "synthetic"):
        shutil.copytree(results / "photos/desk/scene", tmp_path / dataset / "desk/scene")
    with pytest.raises(SettingsError, match=r"several scenes(.|\n)*photos/desk, synthetic/desk"):
        scene_folder("desk", tmp_path)


@pytest.mark.parametrize(
    "command",
    [
        ("query", "dask", "mug"),
        ("view", "dask", "--no-browser"),
        ("annotate", "photos/dask"),
        ("export", "dask"),
        ("datasets", "fits", "dask"),
        ("blocks", "split", "dask", "--blocks", "2"),
        *(("world", command, "dask") for command in ("show", "masks", "inconsistency", "semantic-tree")),
    ],
)
def test_a_wrong_scene_name_suggests_the_right_one_in_every_command(desk_project, monkeypatch, command):
    monkeypatch.chdir(desk_project)
    Path("tests/unit/scene").mkdir(parents=True, exist_ok=True)  # as in a checkout: no scene
    with pytest.raises(ArtifactError, match=r"dask is missing(.|\n)*did you mean 'photos/desk'"):
        run(*command)
    for open_it in (
        lambda: hilsplat.open_scene("results/photos/dask"),
        lambda: hilsplat.open_scenes("results", "dask"),
    ):
        with pytest.raises(ArtifactError, match="did you mean 'photos/desk'"):
            open_it()
    monkeypatch.chdir("tests")
    with pytest.raises(ArtifactError, match=r"is missing(.|\n)*change to the folder of the project"):
        run(*command)


def test_export_writes_the_tree_to_any_folder_without_files(desk, elsewhere, capsys):
    run("export", str(desk), "--out", "tree")
    assert "2 whole, 2 part, 1 subpart" in capsys.readouterr().out
    nodes = json.loads((elsewhere / "tree/tree.json").read_text())["nodes"]
    assert [node["level"] for node in nodes] == ["whole", "whole", "part", "part", "subpart"]
    assert (elsewhere / "tree/tree.png").is_file()
    assert (elsewhere / "tree/tree.ply").stat().st_size > (desk / "gaussians.ply").stat().st_size
    (elsewhere / "mine").mkdir()
    (elsewhere / "mine/thesis.txt").write_text("years of work")
    with pytest.raises(ArtifactError, match="--out mine exists"):
        run("export", str(desk), "--as", "colmap", "--out", "mine")
    assert (elsewhere / "mine/thesis.txt").read_text() == "years of work"


def test_labels_exported_in_the_layout_of_lerf_are_read_back(copied, elsewhere, capsys):
    view, size_hw = "000.png", (HEIGHT, WIDTH + NUM_VIEWS)
    ring = [(1, 1), (5, 1), (5, 4), (1, 4)]
    labels = [
        Label(id=3, level=1, text="mug", polygons=[ring, [(7, 1), (8, 1), (8, 2)]]),
        Label(id=9, level=2, parent=3, text="handle", polygons=[ring]),
    ]
    source = elsewhere / "annotated/photos/desk"
    write_labels(label_path(source, view), view, size_hw, labels, NO_FILE)
    run("export", str(copied), "--as", "labels", "--data-root", ".")
    assert "labels of 1 views" in capsys.readouterr().out
    out = copied / "export/labels"
    assert {path.name for path in out.iterdir()} == {"000.jpg", "000.json"}
    shutil.copytree(out, elsewhere / "back/annotated/photos/desk")
    before, after = (open_labelled("annotated/photos/desk", root) for root in (elsewhere, elsewhere / "back"))
    for one, other in zip(before.views[view], after.views[view], strict=True):
        assert (one.text, one.level, one.path) == (other.text, other.level, other.path)
        assert np.array_equal(one.mask(), other.mask())
        assert np.array_equal(one.boxes(), other.boxes())


def test_variants_open_shared_artifacts_once(copied):
    (copied / "omega-2").mkdir()
    for part in copied.glob("default/field.safetensors*"):
        shutil.copy(part, copied / "omega-2")
    opened = Opened()
    first, second = (open_variant(copied, variant, opened, 1) for variant in ("default", "omega-2"))
    assert first.gaussians is second.gaussians
    assert first.tree is second.tree
    assert first.scene is second.scene
    assert first.field.language is not second.field.language


def test_key_views_are_queried_until_the_vectors_of_all_views_exist(desk, tmp_path, caplog):
    growing = tmp_path / "photos/desk"
    shutil.copytree(desk, growing, ignore=shutil.ignore_patterns("field.safetensors*", "scores.csv*"))
    key = growing / "key-views"
    key.mkdir()
    for part in ("clip", "semantic_tree", "masks"):
        (growing / "default" / part).rename(key / part)
    parts = FinishedScene.locate(growing).parts
    expected = [key / name for name in ("clip", "semantic_tree", "masks")]
    assert [parts.clip, parts.semantic_tree, parts.masks] == expected and parts.field is None
    assert re.search(r"photos/desk uses \d+ of \d+ photographs until the run ends", caplog.text)


def test_results_of_another_user_answer_and_name_the_option_for_files(desk, capsys, monkeypatch):
    can, own = os.access, str(desk)  # root may write everywhere

    def access(path, mode: int, **more: bool) -> bool:
        return can(path, mode, **more) and not (mode == os.W_OK and str(path).startswith(own))

    monkeypatch.setattr(os, "access", access)
    with pytest.raises(SettingsError, match=r"queries(.|\n)*cannot be written(.|\n)*--out"):
        run("query", str(desk), "mug")
    assert "mug" in capsys.readouterr().out and not (desk / "queries").exists()
