"""The pipeline from Python on the desk: the same bytes as the stages, no files left, errors that help."""

import logging
import math
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Barrier, Event
from urllib.request import urlopen

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import hilsplat
from hilsplat import library, stages
from hilsplat.base.errors import ArtifactError, HilsplatError, ModelError, SceneError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.base.lineage import read_provenance, sha256_of_path
from hilsplat.query.scene_views import ViewStore
from hilsplat.scene.exporting import write_colmap
from hilsplat.segment.digests import digest_of, digests_in, load_masks
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import GaussiansSettings, MasksSettings
from hilsplat.splat.ply import save_ply
from hilsplat.splat.rasterise.api import draw, pixel_weights
from hilsplat.splat.steps import fit_steps
from tests.unit.finished_desk import SCENE


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    """The folder of temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def scene(desk) -> hilsplat.Scene:
    return hilsplat.load_scene(desk)


@pytest.fixture
def masks(desk) -> hilsplat.SceneMasks:
    """The desk's own masks."""
    folder, digests = desk / "default/masks", digests_in(desk / "default/masks")
    origin = {"segmenter": "graph", "model": None, "model_sha256": None}
    return hilsplat.SceneMasks({view: load_masks(folder, view, digests) for view in digests}, origin)


@pytest.fixture
def linked(desk, desk_project, scene, masks, temporary) -> hilsplat.LanguageScene:
    gaussians = hilsplat.load_gaussians(desk / "gaussians.ply")
    return hilsplat.link(scene, gaussians, masks, model=str(desk_project / "models/colours"), threads=1)


def test_objects_are_one_line_each_and_cameras_are_found_by_name_and_row(desk, scene, masks, linked):
    hit, rendering = linked.query("mug")[0], linked.render("000.png")
    scores = hilsplat.score({"v": {"a": hit.mask("000.png")}}, {"v": {"a": hit.mask("000.png")}})
    every = (scene, scene.cameras, scene.cameras[0], linked.gaussians, rendering, masks, hit, linked, scores)
    for each in (*every, linked.nodes[0], masks["000.png"]):
        assert "\n" not in repr(each) and len(repr(each)) < 150, repr(each)
    for each in (linked, scene, scene.cameras, scene.cameras[0], linked.gaussians, masks["000.png"]):
        assert {each: "found"}[each] == "found" and each != replace(each)
    assert repr(scene) == "Scene(photos/desk: 6 views (1 held out), 0 points)"
    assert [camera.name for camera in scene.cameras] == list(scene.names)
    np.testing.assert_array_equal(scene.cameras[-1].K, scene.cameras["005.png"].K)
    for wrong in (6, "6.png"):
        with pytest.raises(SceneError, match="has no camera"):
            scene.cameras[wrong]
    assert scene.image("000.png").shape == (*scene.cameras[0].size_hw, 3)


@pytest.mark.parametrize("iterations", [40, None])
def test_a_fit_equals_that_of_the_stage(scene, tmp_path, monkeypatch, iterations):
    monkeypatch.setattr("hilsplat.splat.steps.MIN_FIT_STEPS", 20)
    settings = {"max_gaussians": 500, "densify_every": 10, "device": "cpu"}
    settings |= {} if iterations else {"steps_per_view": 5}
    found = hilsplat.fit(scene, iterations, seed=3, threads=2, **settings)
    steps = {"iterations": iterations, "steps_per_view": iterations} if iterations else {}
    out, section = tmp_path / "gaussians.ply", GaussiansSettings(**settings, **steps)
    assert fit_steps(section, 5) == (iterations or 25)
    stages.gaussians(scene.folder, out, tmp_path / "report", section, cache=tmp_path / "cache", seed=3)
    save_ply(tmp_path / "ours.ply", found)
    assert (tmp_path / "ours.ply").read_bytes() == out.read_bytes()
    other = hilsplat.fit(scene, iterations, seed=4, threads=1, **settings)
    assert len(other) != len(found) or not np.array_equal(other.means, found.means)


def test_masks_equal_those_of_the_stage_and_the_automatic_segmenter_is_the_graph(
    scene, tmp_path, temporary, monkeypatch
):
    found = hilsplat.segment(scene, segmenter="graph", graph_scales=(0.3, 0.1, 0.05), threads=2)
    section = MasksSettings(segmenter="graph", graph_scales=(0.3, 0.1, 0.05))
    stages.masks(scene.folder, tmp_path / "masks", section, tmp_path / "cache")
    digests = digests_in(tmp_path / "masks")
    assert {view: digest_of(each) for view, each in found.items()} == digests
    assert found.origin == {"segmenter": "graph"}
    assert not list(temporary.iterdir())
    # a cache keeps finished views
    kept = tmp_path / "kept"
    monkeypatch.setenv("HOME", str(tmp_path))
    hilsplat.segment(scene, segmenter="graph", cache="~/kept")
    entries = sha256_of_path(kept)
    hilsplat.segment(scene, segmenter="graph", cache=kept)
    assert sha256_of_path(kept) == entries and len(list(kept.rglob("*.npz"))) == len(found)
    found = hilsplat.segment(scene)  # tests see the embedded models only, which are not for photographs
    assert found.origin == {"segmenter": "graph"}
    with pytest.raises(ModelError, match="nowhere"):
        hilsplat.segment(scene, model="nowhere")


def test_the_tree_equals_that_of_the_stages_and_answers_alike(desk, desk_project, linked, temporary):
    own = SemanticTree.load(desk / "default/semantic_tree", desk / "default/clip")
    for name, values in vars(own).items():
        np.testing.assert_array_equal(getattr(linked.tree, name), values, err_msg=name)
    opened = hilsplat.open_scene(desk)
    for text in ("mug", "mug > handle", "book"):
        ours, theirs = linked.query(text), opened.query(text)
        assert [(hit.node, hit.score, hit.route) for hit in ours] == [
            (hit.node, hit.score, hit.route) for hit in theirs
        ]
    assert linked.query("unicorn")[0].doubts
    assert not list(temporary.iterdir())
    with pytest.raises(ArtifactError, match="no language field"):
        _ = linked.field


def test_answers_have_masks_in_any_camera_and_are_nodes_of_the_tree(linked):
    hit, view = linked.query("mug > handle")[0], "002.png"
    camera = linked.camera(view)
    np.testing.assert_array_equal(hit.mask(camera), hit.mask(view))
    assert hit.mask(view).any()
    half = camera.scaled(tuple(side // 2 for side in camera.size_hw))
    assert hit.mask(half).shape == half.size_hw and hit.mask(half).any()
    for call in (hit.mask, linked.camera, linked.render):
        with pytest.raises(SettingsError, match="has no view 'x'"):
            call("x")
    assert [node.node for node in linked.nodes] == list(range(len(linked.tree)))
    hit = linked.query("mug > handle")[0]
    node = linked.nodes[hit.node]
    assert (node.level, node.parent, node.box, node.name) == (hit.level, hit.parent, hit.box, hit.name)
    assert linked.nodes[node.parent].level == hilsplat.Level.WHOLE
    np.testing.assert_array_equal(node.gaussians, hit.gaussians)


def test_a_rendering_has_colours_depth_features_and_alpha(linked):
    gaussians, camera = linked.gaussians, linked.camera("001.png")
    features = np.random.default_rng(0).normal(size=(len(gaussians), 5)).astype(np.float32)
    found = hilsplat.render(gaussians, camera, features, background=(1.0, 0.5, 0.0), threads=1)
    seen = draw(gaussians, camera, gaussians.sh_degree)
    expected = seen.image + (1 - seen.alpha)[..., None] * np.float32([1, 0.5, 0])
    np.testing.assert_array_equal(found.colours, expected)
    weights = pixel_weights(gaussians, camera, min_weight=0.0)
    height, width = camera.size_hw
    blended = (weights @ features).reshape(height, width, 5)
    np.testing.assert_allclose(found.features, blended, atol=1e-5)
    np.testing.assert_allclose(found.alpha, np.asarray(weights.sum(axis=1)).reshape(height, width), atol=1e-5)
    covered = found.alpha > 0
    np.testing.assert_allclose(found.depth[covered], 30.0, atol=1e-3)  # all Gaussians are in one plane
    assert np.isnan(found.depth[~covered]).all()
    plain = linked.render("001.png")
    assert plain.features.shape == (height, width, 0)
    np.testing.assert_array_equal(plain.colours, seen.image)


def export_colmap(desk, out):
    """Write the scene as a COLMAP model, with principal points in the middle: importers refuse its own."""
    scene = hilsplat.load_scene(desk)
    K = scene.cameras.K.copy()
    K[:, :2, 2] = scene.cameras.size_hw[:, ::-1] / 2
    write_colmap(replace(scene, cameras=replace(scene.cameras, K=K)), out)


def test_a_folder_keeps_a_scene_that_opens(own_desk, desk, desk_project, masks, tmp_path):
    export_colmap(desk, tmp_path / "colmap")
    folder, model = tmp_path / "results/photos/again", str(desk_project / "models/colours")
    scene = hilsplat.load_scene(tmp_path / "colmap", folder=folder, test_every=6)
    assert (scene.name, scene.folder) == ("photos/again", folder / "scene")
    gaussians = hilsplat.load_gaussians(desk / "gaussians.ply", scene)
    views = scene.views("train")
    of_views = hilsplat.SceneMasks({view: masks[view] for view in views if view in masks}, masks.origin)
    linked = hilsplat.link(scene, gaussians, of_views, model=model, folder=folder)
    again = hilsplat.open_scene(folder)
    assert len(again.nodes) == len(linked.nodes) > 0
    assert [hit.node for hit in again.query("mug")] == [hit.node for hit in linked.query("mug")]
    assert hilsplat.load_scene(folder).names == scene.names
    few = hilsplat.link(scene, gaussians, of_views, model=model, folder=folder, min_views=9)  # replaces it
    assert len(few.nodes) == len(hilsplat.open_scene(folder).nodes) == 0
    with pytest.raises(ArtifactError, match="elsewhere is not the folder of photos/again"):
        hilsplat.link(scene, gaussians, of_views, model=model, folder=tmp_path / "elsewhere")
    before = sha256_of_path(own_desk)
    for call in (
        lambda: hilsplat.link(hilsplat.load_scene(own_desk), gaussians, of_views, folder=own_desk),
        lambda: hilsplat.load_scene(tmp_path / "colmap", folder=own_desk),
        lambda: hilsplat.reconstruct(tmp_path / "colmap", folder=own_desk),
    ):
        with pytest.raises(ArtifactError, match=r"has results of a run(.|\n)*open_scene"):
            call()
    assert sha256_of_path(own_desk) == before


def test_files_of_imported_poses_are_deleted_with_the_scene(desk, tmp_path, temporary, monkeypatch):
    exported = tmp_path / "colmap"
    export_colmap(desk, exported)
    imported = hilsplat.load_scene(exported, test_every=0)
    folder = imported.folder
    assert imported.names == tuple(f"{number:03d}.png" for number in range(6))
    assert imported.views("test") == [] and imported.name == "photos/colmap"
    assert folder.is_relative_to(temporary) and imported.image("000.png").any()
    gaussians = hilsplat.load_gaussians(desk / "gaussians.ply", imported)
    own = replace(hilsplat.load_scene(desk).cameras[0], K=imported.cameras[0].K)
    difference = (
        hilsplat.render(gaussians, imported.cameras[0]).colours
        - hilsplat.render(hilsplat.load_gaussians(desk / "gaussians.ply"), own).colours
    )
    assert np.abs(difference).mean() < 0.01
    if (child := os.fork()) == 0:
        del imported
        os._exit(0)
    os.waitpid(child, 0)
    assert folder.exists()
    del imported
    assert not folder.exists() and not list(temporary.iterdir())
    monkeypatch.setenv("HOME", str(tmp_path))
    kept = hilsplat.load_scene("~/colmap", folder="~/results/photos/kept")
    assert kept.folder == tmp_path / "results/photos/kept/scene"


def test_wrong_paths_and_settings_are_explained(desk, desk_project, scene, tmp_path, monkeypatch, temporary):
    monkeypatch.chdir(desk_project)
    with pytest.raises(ArtifactError, match="did you mean 'photos/desk'"):
        hilsplat.load_scene("results/photos/dask")
    with pytest.raises(SettingsError, match="is posed already"):
        hilsplat.load_scene(desk, max_side_px=800)
    with pytest.raises(SettingsError, match="max_side: unknown key; did you mean 'max_side_px'"):
        hilsplat.reconstruct(desk / "scene/images", max_side=800)
    with pytest.raises(SettingsError, match="iteratons: unknown key"):
        hilsplat.fit(scene, iteratons=5)
    with pytest.raises(SceneError, match=r"has no known poses(.|\n)*hilsplat.reconstruct"):
        hilsplat.load_scene(desk / "scene/images")
    with pytest.raises(SceneError, match="is missing"):
        hilsplat.reconstruct(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(HilsplatError, match="too few images"):
        hilsplat.reconstruct(tmp_path / "empty")
    assert not list(temporary.iterdir())


def test_progress_is_reported_only_on_request(scene, capsys, monkeypatch):
    logs = logging.getLogger("hilsplat")
    before = logs.level, list(logs.handlers)
    hilsplat.segment(scene, segmenter="graph")
    assert capsys.readouterr().err == ""
    hilsplat.segment(scene, segmenter="graph", progress=True)
    assert "graph segmenter" in capsys.readouterr().err
    assert (logs.level, logs.handlers) == before
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)  # bars, too
    hilsplat.segment(scene, segmenter="graph")
    assert capsys.readouterr().err == ""
    hilsplat.segment(scene, segmenter="graph", progress=True)
    assert "masks of views" in capsys.readouterr().err


def test_overlapping_calls_leave_the_process_as_it_was(scene, monkeypatch):
    both_run, first_ended, during = Barrier(2), Event(), []

    def segment_views(scene, views, cache, section, threads):
        both_run.wait()
        if threads == 2:
            first_ended.wait()
            during.append((logs.level, blas_threads()))
        return [], {}

    def blas_threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    monkeypatch.setattr("hilsplat.library.segment_views", segment_views)
    logs = logging.getLogger("hilsplat")
    with ThreadPoolExecutor(2) as pool, threadpool_limits(2):
        before = logs.level, list(logs.handlers), blas_threads()
        first, second = (
            pool.submit(hilsplat.segment, scene, segmenter="graph", progress=True, threads=threads)
            for threads in (1, 2)
        )
        first.result()
        first_ended.set()
        second.result()
        assert (logs.level, logs.handlers, blas_threads()) == before
    assert during == [(logging.INFO, {1})]


SCRIPT = """
import os, sys
import hilsplat
from hilsplat.base.processes import in_own_process
scene = hilsplat.load_scene(sys.argv[1], folder="kept")
print("once", in_own_process(sorted, [2, 1]), scene.name)
print("children:", open(f"/proc/self/task/{os.getpid()}/children").read())
"""


def test_a_script_without_a_guard_is_not_run_again_by_child_processes(desk, tmp_path, project):
    (tmp_path / "script.py").write_text(SCRIPT)
    export_colmap(desk, tmp_path / "colmap")
    paths = os.pathsep.join([str(project), os.environ.get("PYTHONPATH", "")])
    how = {"capture_output": True, "text": True, "cwd": tmp_path, "timeout": 120}
    how["env"] = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "script.py", "colmap"], **how)
    # a remaining child would delay the end of a notebook's kernel, which is killed before it can clean up
    assert done.stdout == "once [1, 2] photos/kept\nchildren: \n", done.stderr
    assert read_provenance(tmp_path / "kept/scene").command == ()  # not that of the script


def test_arrays_and_arguments_that_do_not_fit_are_refused(desk, scene, masks, linked):
    """Compiled loops would read beyond the end of a short array, and indices wrap around."""
    gaussians, camera = linked.gaussians, linked.camera("000.png")
    red, field = np.zeros((4, 6, 3), np.uint8), hilsplat.open_scene(desk).field
    count, pixels = len(gaussians), math.prod(camera.size_hw)
    calls = {
        r"array quats (.|\n)*of shape \(9, 4\)": lambda: replace(gaussians, quats=gaussians.quats[:9]),
        "array means (.|\n)*float64": lambda: replace(gaussians, means=gaussians.means.astype(float)),
        "K = 1, 4, 9 or 16": lambda: replace(gaussians, sh=np.zeros((count, 2, 3), np.float32)),
        "focal lengths above 0": lambda: replace(camera, K=camera.K * [[-1], [1], [1]]),
        "without skew": lambda: replace(camera, K=camera.K + np.eye(3, k=1) * [[1], [0], [0]]),
        "K.1, 0. are": lambda: replace(camera, K=camera.K + np.eye(3, k=-1) * [[0], [1e-3], [0]]),
        "rigid poses": lambda: replace(camera, cam_from_world=camera.cam_from_world * 2),
        "finite numbers": lambda: replace(camera, K=camera.K * np.nan),
        "array cam_from_world": lambda: replace(camera, cam_from_world=camera.cam_from_world[:3]),
        "size .0, 9.": lambda: camera.scaled((0, 9)),
        "whole px": lambda: camera.scaled((24.0, 36.5)),
        "Camera\n(.|\n)*str 000.png": lambda: hilsplat.render(gaussians, "000.png"),
        "Gaussians\n(.|\n)*str a.ply": lambda: hilsplat.render("a.ply", camera),
        "Gaussians\n(.|\n)*str b.ply": lambda: hilsplat.link(scene, "b.ply", masks),
        "Scene\n(.|\n)*str a(.|\n)*load_scene": lambda: hilsplat.fit("a"),
        "Scene\n(.|\n)*str b(.|\n)*load_scene": lambda: hilsplat.segment("b"),
        "Scene\n(.|\n)*str c(.|\n)*load_scene": lambda: hilsplat.link("c", gaussians, masks),
        "Scene\n(.|\n)*str d(.|\n)*load_scene": lambda: hilsplat.load_gaussians(desk / "gaussians.ply", "d"),
        f"features (.|\n)*{count}, D": lambda: hilsplat.render(gaussians, camera, np.ones((5, 2))),
        "split 'tset' is unknown": lambda: scene.views("tset"),
        "of no views": lambda: hilsplat.link(scene, gaussians, hilsplat.SceneMasks({}, masks.origin)),
        "found +dict of 000.png": lambda: hilsplat.link(scene, gaussians, dict(masks)),
        "node 99 does not exist": lambda: linked.views.node_masks("000.png", [0, 99]),
        "node -1 does not": lambda: linked.views.gaussians_of([-1]),
        "node 0.5 does not": lambda: linked.like_node(0.5),
        "uint8(.|\n)*float64": lambda: linked.like_picture(red / 255),
        r"\(4, 6, 4\)": lambda: linked.like_picture(np.dstack([red, red[..., 0]])),
        r"\(0, 6, 3\)": lambda: linked.like_picture(red[:0]),
        "'mug' is not a list": lambda: linked.node_cosine("mug", "000.png", np.array([0])),
        "'mug' is": lambda: linked.node_relevancy_map("mug", "000.png"),
        r"\[\] is not a list": lambda: linked.node_relevancy_map([], "000.png"),
        "pixel of 000.png: -1": lambda: linked.node_cosine(["mug"], "000.png", np.array([0, -1])),
        f"000.png: {pixels} does": lambda: linked.node_cosine(["mug"], "000.png", np.array([pixels])),
        "node True does not exist": lambda: linked.views.node_masks("000.png", [True]),
        "limit is -2": lambda: linked.query("mug", limit=-2),
        "limit is -1": lambda: linked.like_node(0, limit=-1),
        "limit is None": lambda: linked.query("mug", limit=None),
        "seed is -1": lambda: hilsplat.fit(scene, 3, seed=-1),
        "seed is 1.5": lambda: hilsplat.fit(scene, 3, seed=1.5),
        "seed is '1'": lambda: hilsplat.reconstruct("x.zip", seed="1"),
        "level 7 is unknown": lambda: linked.query("mug", level=7),
        "level 'hole' is unknown": lambda: masks["000.png"].label_map("hole"),
        r"node \[0, 1\] does not exist": lambda: linked.views.gaussians_of([[0, 1]]),
        "no Gaussians": lambda: hilsplat.link(
            scene, hilsplat.Gaussians(*(array[:0] for array in vars(gaussians).values())), masks
        ),
        "level 'piece' is unknown": lambda: field.gaussian_relevancy("mug", "piece"),
        "level 'bit' is unknown": lambda: field.image("000.png", "bit"),
        r"\[3, 1\] does not exist": lambda: field.cosine(["mug"], camera, np.array([[3, 1]])),
        "-7 does not exist": lambda: field.cosine(["mug"], "000.png", np.array([-7])),
        "'book' is not a list": lambda: field.relevancy("book", "000.png"),
        "'rim' is not a list": lambda: field.cosine("rim", "000.png", np.array([0])),
        "not a colour": lambda: hilsplat.render(gaussians, camera, background=(0, 0, 0, 1)),
    }
    for message, call in calls.items():
        with pytest.raises(HilsplatError, match=message):
            call()


def test_a_changed_camera_changes_no_other(scene):
    camera = scene.cameras["001.png"]
    smaller, before = camera.scaled((12, 21)), scene.cameras.K.copy()
    camera.K[0, 0] *= 2
    camera.cam_from_world[0, 3] += 1
    np.testing.assert_array_equal(scene.cameras.K, before)
    assert (
        smaller.cam_from_world[0, 3]
        == scene.cameras["001.png"].cam_from_world[0, 3]
        != camera.cam_from_world[0, 3]
    )


def test_opened_scenes_do_not_follow_the_working_folder(desk_project, tmp_path, monkeypatch):
    """Another project may have scenes of the same names."""
    shutil.copytree(desk_project / SCENE, other := tmp_path / SCENE)
    for image in (other / "scene/images").glob("*.png"):
        write_png(image, np.zeros((24, 42, 3), np.uint8))
    shutil.rmtree(other / "default")
    monkeypatch.chdir(desk_project)
    posed, opened, shown = hilsplat.load_scene(SCENE), hilsplat.open_scene(SCENE), hilsplat.show(SCENE)
    before, address = posed.image("000.png"), f"http://127.0.0.1:{shown.port}/api/photo/0?token={shown.token}"
    monkeypatch.chdir(tmp_path)
    for after in (posed.image("000.png"), opened.views.image("000.png")):
        np.testing.assert_array_equal(after, before)
    with urlopen(address) as photograph:
        assert photograph.read() == (desk_project / SCENE / "scene/images/000.png").read_bytes()
    shown.close()
    assert opened.query("mug")[0].mask("000.png").any()


def test_a_scene_can_be_sent_to_another_process_without_its_cache(desk):
    scene = hilsplat.open_scene(desk)
    size, hits = len(pickle.dumps(scene)), scene.query("mug > handle", answerer="field", view="000.png")
    mask = hits[0].mask("000.png")
    sent = pickle.loads(pickle.dumps(scene))
    found = sent.query("mug > handle", answerer="field", view="000.png")
    assert found == hits and sent.like_picture(sent.views.image("000.png"))
    np.testing.assert_array_equal(found[0].mask("000.png"), mask)
    assert len(pickle.dumps(scene)) < 1.1 * size


def test_a_function_can_be_sent_to_another_process():
    assert pickle.loads(pickle.dumps(hilsplat.segment)) is library.segment


def test_levels_are_found_by_number_and_label(desk, masks, linked):
    field = hilsplat.open_scene(desk).field
    for level in hilsplat.Level:
        expected = masks["000.png"].label_map(level)
        for same in (int(level), level.label):
            np.testing.assert_array_equal(masks["000.png"].label_map(same), expected)
            assert linked.query("mug", level=same) == linked.query("mug", level=level)
            np.testing.assert_array_equal(field.image("000.png", same), field.image("000.png", level))


def test_threads_may_read_one_scene():
    """Each thread drops results that others are about to read."""
    store = ViewStore(max_mib=400 / 2**20)  # five of twenty results

    def read(first: int) -> bool:
        views = [7 * number + first for number in range(5000)]
        return all(
            (store.get(("k", view % 20), partial(np.full, 10, view % 20)) == view % 20).all()
            for view in views
        )

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            assert all(pool.map(read, range(8)))
    finally:
        sys.setswitchinterval(interval)
