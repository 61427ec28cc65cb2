"""Poses, points and Gaussians in other coordinates or axes than their format has don't pass unnoticed."""

from dataclasses import replace

import numpy as np
import pytest

from hilsplat.base.images import to_float
from hilsplat.scene.importers.importing import misfit_notes
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import find_known_poses
from hilsplat.splat.gaussians import SH_0
from hilsplat.splat.ply import save_ply
from hilsplat.workflow.new_scene import add_scene
from tests.imports import analytic_world as world
from tests.unit.round_gaussians import round_gaussians

WIDTH, HEIGHT, RAYS = 160, 120, world.pinhole(150, 150, 80, 60)
POSES = {f"{row}.png": pose for row, pose in enumerate(world.cameras(12))}
XYZ = np.column_stack([np.random.default_rng(0).uniform(-1.2, 1.2, (1500, 2)), np.zeros(1500)])
XYZ = XYZ[np.linalg.norm(XYZ - world.BALL, axis=1) > 2 * world.RADIUS]  # not below the ball
RGB = np.rint(255 * 0.8 * world.pattern(XYZ)).astype(np.uint8)
OTHER_AXES = {  # what scripts and other programs write instead of poses, or of points
    "OpenGL's camera axes": (lambda pose: pose @ world.OPENGL, XYZ),
    "the inverse": (np.linalg.inv, XYZ),
    "y up": (None, XYZ[:, [0, 2, 1]] * [1, 1, -1]),
    "COLMAP's axes beside nerfstudio's poses": (None, XYZ[:, [1, 0, 2]] * [1, 1, -1]),
    "centred and half as large": (None, 0.5 * XYZ - [1.0, 0.4, 0]),
}

PICTURES = {name: world.picture(RAYS, WIDTH, HEIGHT, pose) for name, pose in POSES.items()}


def scene(folder, change=None, xyz=XYZ, colours=RGB, count=12):
    names = [*POSES][:count]
    world.save(folder / "images", {name: PICTURES[name] for name in names}, "")
    poses = {name: change(POSES[name]) if change else POSES[name] for name in names}
    points = [(*place, *colour) for place, colour in zip(xyz.tolist(), colours.tolist(), strict=True)]
    world.write_colmap(folder / "sparse/0", "PINHOLE 150 150 80 60", (WIDTH, HEIGHT), poses, points)
    return folder


@pytest.mark.parametrize("case", OTHER_AXES)
def test_points_that_do_not_match_the_images_are_reported(case, tmp_path, imported):
    *_, report = imported(scene(tmp_path / "in", *OTHER_AXES[case]))
    (warning,) = report["warnings"]
    assert warning.startswith("the points don't match the images")


def test_matching_points_and_those_without_colours_raise_no_doubt(tmp_path, imported):
    *_, report = imported(scene(tmp_path / "in"))
    assert not report["warnings"]
    views, grey = read_source(find_known_poses(tmp_path / "in")).views, np.full_like(RGB, 128)
    assert misfit_notes(views, (XYZ, grey), "points") == []
    assert misfit_notes(views, (XYZ[:99] + 9, RGB[:99]), "points") == []
    assert "only 0 of" in misfit_notes(views, (XYZ + 99, grey), "points")[0]


@pytest.mark.parametrize("case", [None, "y up", "centred and half as large"])
def test_gaussians_in_other_coordinates_are_reported_before_the_run(case, tmp_path):
    folder = scene(tmp_path / "in")
    gaussians = round_gaussians(OTHER_AXES[case][1] if case else XYZ, opacity_logit=2.0)
    colours = ((to_float(RGB) - 0.5) / SH_0)[:, None]
    save_ply(folder / "point_cloud.ply", replace(gaussians, sh=colours.astype(np.float32)))
    report = str(add_scene(tmp_path / "scenes.tsv", "a", folder, dry_run=True))
    assert "the points don't match" not in report
    assert ("the Gaussians don't match the images" in report) == (case is not None)


def test_poses_with_which_nothing_can_be_triangulated_are_reported(tmp_path, imported):
    *_, report = imported(scene(tmp_path / "in", np.linalg.inv, XYZ[:0], RGB[:0], count=4))
    (warning,) = report["warnings"]
    assert warning.startswith("only 0.0 points per registered view")
