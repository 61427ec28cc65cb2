"""Similarity transforms of Gaussians, and their import as other programs write them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilsplat.base.artifacts import read_json, write_json
from hilsplat.base.errors import ArtifactError, HilsplatError, SceneError
from hilsplat.base.images import write_png
from hilsplat.scene.assemble import move_cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.export import write_selection_ply
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.coordinates import decompose, import_gaussians, move_gaussians, write_source_ply
from hilsplat.splat.fit import run_gaussians
from hilsplat.splat.ply import load_ply, save_ply
from hilsplat.splat.rasterise.api import render
from tests.unit.splat.rasterise_scenes import camera, random_gaussians, rows
from tests.unit.splat.three_gaussians_world import mean_psnr, three_gaussians, three_gaussians_scene


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_rendered_view_is_unchanged_under_a_similarity(degree):
    some, view = random_gaussians(300, degree, degree), camera()
    gaussians = rows(some, some.means @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3] > 1)
    similarity = np.eye(4)
    similarity[:3, :3] = 0.37 * Rotation.random(rng=np.random.default_rng(7)).as_matrix()
    similarity[:3, 3] = (5.0, -3.0, 2.0)
    before = render(gaussians, view).colours
    moved = replace(view, cam_from_world=move_cameras(view.cam_from_world[None], similarity)[0])
    after = render(move_gaussians(gaussians, similarity), moved).colours
    assert before.mean() > 0.05
    # float32 parameters; a pixel at the cut of 1/255 may fall on either side
    np.testing.assert_allclose(after, before, atol=5e-3)
    assert np.abs(after - before).mean() < 1e-5


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([1.0, 2.0, 1.0, 1.0]), np.full((4, 4), np.nan)],
    ids=["mirrors", "stretches", "not finite"],
)
def test_a_matrix_that_is_not_a_similarity_is_refused(matrix):
    with pytest.raises(HilsplatError, match="not a similarity"):
        decompose(matrix)


COMPARED = ("means", "log_scales", "opacity_logits", "sh")
"""All fields but the quaternions: a quaternion and its negative are the same rotation."""


@pytest.fixture(scope="module")
def turned_scene(tmp_path_factory) -> Scene:
    """The three Gaussians, with a source that is rotated, six times as large and shifted."""
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix() / 6
    transform[:3, 3] = (0.5, -1.0, 2.0)
    return three_gaussians_scene(tmp_path_factory.mktemp("turned") / "scene", transform)


@pytest.fixture
def source_ply(turned_scene, tmp_path) -> Path:
    """The true Gaussians in the source's coordinates."""
    path = tmp_path / "theirs.ply"
    save_ply(path, move_gaussians(three_gaussians(), np.linalg.inv(turned_scene.scene_from_source)))
    return path


def stage_output(scene: Scene, existing: Path, tmp_path: Path) -> Path:
    """The folder with PLY, JSON and report of a run of the stage."""
    out = tmp_path / "out"
    settings = GaussiansSettings()
    run_gaussians(scene.folder, out / "g.ply", out / "report", tmp_path, settings, 0, 1, existing=existing)
    return out


@pytest.fixture
def out(turned_scene, source_ply, tmp_path, monkeypatch) -> Path:
    """The folder with PLY, JSON and report of the imported Gaussians; a fit would fail."""
    monkeypatch.setattr("hilsplat.splat.fit.fit_gaussians", None)
    return stage_output(turned_scene, source_ply, tmp_path)


def test_the_stage_imports_gaussians_in_source_coordinates_without_a_fit(out):
    existing, truth = load_ply(out / "g.ply"), three_gaussians()
    for name in COMPARED:
        np.testing.assert_allclose(getattr(existing, name), getattr(truth, name), atol=1e-5)
    report = read_json(out / "report" / "report.json")
    assert report["origin"]["kind"] == "imported"
    assert report["origin"]["file"] == "theirs.ply"
    assert report["origin"]["taken_as"] == "in the coordinates of the scene's source"
    assert report["split"] == "test"
    assert report["psnr_db"] > 45
    assert report["warnings"] == []
    assert not (out / "report" / "curves.png").exists()
    assert (out / "report" / "flyaround.png").is_file()
    assert read_json(out / "g.json")["origin"]["kind"] == "imported"


def test_gaussians_in_other_coordinates_are_reported(turned_scene, tmp_path):
    save_ply(tmp_path / "elsewhere.ply", three_gaussians())
    out = stage_output(turned_scene, tmp_path / "elsewhere.ply", tmp_path)
    assert "different coordinates" in read_json(out / "report" / "report.json")["warnings"][0]


def test_a_view_without_error_has_a_finite_score_and_one_colour_is_no_yardstick(tmp_path):
    scene = three_gaussians_scene(tmp_path / "scene")
    scene.cameras.cam_from_world[7, [0, 2]] *= -1  # turn the camera away from the Gaussians
    write_png(scene.folder / "images/007.png", np.zeros((48, 48, 3), np.uint8))
    scene.save()
    save_ply(tmp_path / "truth.ply", three_gaussians())
    report = stage_output(scene, tmp_path / "truth.ply", tmp_path) / "report/report.json"
    scores = json.loads(report.read_text(), parse_constant=pytest.fail)
    assert scores["views"]["007.png"]["psnr_db"] == 120 and scores["warnings"] == []


def test_a_ply_of_this_package_is_moved_by_the_json_beside_it(turned_scene, source_ply, out):
    again, origin = import_gaussians(out / "g.ply", turned_scene)
    np.testing.assert_allclose(again.means, three_gaussians().means, atol=1e-5)
    assert "JSON" in origin["taken_as"]
    shutil.copyfile(source_ply, out / "g.ply")
    with pytest.raises(ArtifactError, match="was not made from"):
        import_gaussians(out / "g.ply", turned_scene)
    write_json(out / "g.json", {"something": "else"})
    again, origin = import_gaussians(out / "g.ply", turned_scene)
    assert "JSON" not in origin["taken_as"]


@pytest.mark.parametrize("how", ["applied", "old", "colmap"])
def test_a_nerfstudio_ply_is_moved_to_scene_coordinates(turned_scene, source_ply, tmp_path, how):
    orient = np.eye(4)  # of the poses in transforms.json: turned upright and centred
    orient[:3, :3] = Rotation.from_rotvec([0.7, 0.2, -1.1]).as_matrix()
    orient[:3, 3] = (3.0, -1.0, 0.5)
    scale = 0.21  # so that all cameras are in the unit cube
    applied, content = np.eye(4), {}
    if how != "colmap":  # by ns-process-data, from COLMAP
        applied[:3] = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    if how == "applied":
        content = {"applied_transform": applied[:3].tolist(), "applied_scale": 2.5}
    if how == "old":
        (tmp_path / "colmap/sparse/0").mkdir(parents=True)
    transforms, dataparser = tmp_path / "transforms.json", tmp_path / "dataparser_transforms.json"
    write_json(transforms, {**content, "frames": []})
    recorded = scale * content.get("applied_scale", 1.0)
    write_json(dataparser, {"transform": (orient @ applied)[:3].tolist(), "scale": recorded})
    training_from_source = np.diag([scale, scale, scale, 1.0]) @ orient
    save_ply(tmp_path / "splat.ply", move_gaussians(load_ply(source_ply), training_from_source))
    poses = None if how == "colmap" else transforms
    existing, origin = import_gaussians(tmp_path / "splat.ply", turned_scene, dataparser, poses)
    direct, _ = import_gaussians(source_ply, turned_scene)
    np.testing.assert_allclose(existing.means, direct.means, atol=1e-5)
    assert mean_psnr(turned_scene, existing) == pytest.approx(mean_psnr(turned_scene, direct), abs=0.01)
    assert "nerfstudio" in origin["taken_as"]


@pytest.mark.parametrize(
    "content",
    ["[", "[]", {"transform": [[1, 0]], "scale": 1}, {"transform": np.eye(3, 4).tolist(), "scale": 0}],
)
def test_a_damaged_dataparser_file_is_named(turned_scene, source_ply, tmp_path, content):
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(SceneError, match=r"dataparser_transforms\.json"):
        import_gaussians(source_ply, turned_scene, path)


def test_exported_gaussians_are_in_the_sources_coordinates(source_ply, out, tmp_path):
    assert write_source_ply(out / "g.ply", tmp_path / "exported.ply") == len(three_gaussians())
    exported, theirs = load_ply(tmp_path / "exported.ply"), load_ply(source_ply)
    for name in COMPARED:
        np.testing.assert_allclose(getattr(exported, name), getattr(theirs, name), atol=1e-4)
    (out / "g.json").unlink()
    with pytest.raises(ArtifactError, match=r"g\.json is missing"):
        write_source_ply(out / "g.ply", tmp_path / "again.ply")


def test_an_exported_selection_returns_to_its_place_without_the_json(turned_scene, out, tmp_path):
    selection, chosen = tmp_path / "selection.ply", np.array([0, 2])
    write_selection_ply(out / "g.ply", chosen, selection, comments=["label 1: mug", *["long " * 99] * 99])
    again, origin = import_gaussians(selection, turned_scene)
    assert "header" in origin["taken_as"]
    ours = load_ply(out / "g.ply")
    for name in COMPARED:
        np.testing.assert_allclose(getattr(again, name), getattr(ours, name)[chosen], atol=1e-5)
    selection.write_bytes(selection.read_bytes().replace(b"source_from_scene ", b"source_from_scene 1 ", 1))
    with pytest.raises(ArtifactError, match="comment source_from_scene"):
        import_gaussians(selection, turned_scene)


def test_a_ply_without_gaussians_is_refused_with_the_column_to_correct(turned_scene, tmp_path):
    save_ply(tmp_path / "none.ply", rows(three_gaussians(), slice(0)))
    with pytest.raises(ArtifactError, match=r"none\.ply contains no Gaussians(.|\n)*gaussians column"):
        import_gaussians(tmp_path / "none.ply", turned_scene)
