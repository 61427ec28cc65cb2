"""Pictures of every lens model become the exact pinhole pictures, or are refused."""

import numpy as np
import pycolmap
import pytest

from hilsplat.base.errors import HilsplatError, SceneError
from hilsplat.datasets.labelled import posed_images
from tests.imports import analytic_world as world

WIDTH, HEIGHT, FOCAL = 144, 112, 120.0
POSES = {"a.png": world.cameras()[1]}
POINTS = [(0.0, 0.1 * row, 0.0, 200, 100, 50) for row in range(5)]

# Distortion coefficients as small as calibrations of good lenses have them, and as large as action cameras'.
SMALL, LARGE = 1e-3, 0.12
FISHEYES = {"SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"}
FISHEYES |= {"RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"}
OTHERS = {"FOV": (0.0, 0.05, 0.9), "EUCM": ((0.0, 1.0), (0.05, 1.0), (0.6, 1.1))}
MODELS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})


def lens_of(model, amount):
    """A camera with the first distortion coefficients of a model set; `amount` is 0, 1 or 2."""
    camera = pycolmap.Camera.create_from_model_name(1, model, FOCAL, WIDTH, HEIGHT)
    extra = camera.extra_params_idxs()
    values = OTHERS.get(model, (0.0, SMALL, -LARGE if "DIV" in model else LARGE))
    params = camera.params.copy()
    for index, value in zip(extra, np.atleast_1d(values[amount]), strict=False):
        params[index] = value
    camera.params = params
    return camera


def scene_of(camera, folder):
    """The pictures that COLMAP's definition of the lens gives, and their model."""

    def rays(xy):
        plain = np.asarray(camera.cam_from_img(xy))
        return np.column_stack([plain, np.ones(len(plain))])

    pictures = {name: world.picture(rays, WIDTH, HEIGHT, pose) for name, pose in POSES.items()}
    world.save(folder / "images", pictures, suffix="")
    lens = f"{camera.model_name} {' '.join(map(repr, camera.params.tolist()))}"
    world.write_colmap(folder / "sparse/0", lens, (WIDTH, HEIGHT), POSES, POINTS)
    return folder


@pytest.mark.parametrize("amount", [0, 1, 2], ids=["zero", "small", "large"])
@pytest.mark.parametrize("model", MODELS)
def test_pictures_of_every_model_become_pinhole_pictures(model, amount, tmp_path, imported):
    camera = lens_of(model, amount)
    views, *_ = imported(scene_of(camera, tmp_path / "in"))
    is_plain = model in ("PINHOLE", "SIMPLE_PINHOLE") or (amount == 0 and model not in {*FISHEYES, "EUCM"})
    world.require_right(views, POSES, 45 if is_plain else 28)
    assert all((view.photo is None) == is_plain for view in views)


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "FISHEYE"])
def test_labelled_data_sets_refuse_fisheye_lenses_without_coefficients(model, tmp_path):
    with pytest.raises(SceneError, match=rf"lens distortion(.|\n)*{model}"):
        posed_images(scene_of(lens_of(model, 0), tmp_path), "LERF")


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ("EQUIRECTANGULAR 144 112", "panoramas are not supported"),
        ("OPENCV 120 120 72 56 -1.5 0 0 0", "distortion of view a.png cannot be undone"),
        ("FULL_OPENCV 120 120 72 56 -2 0 0 0 0 0 0 0", "distortion of view a.png cannot be undone"),
        ("SIMPLE_RADIAL nan 72 56 0", "lens of view a.png is not valid"),
        ("PINHOLE 120 0 72 56", "lens of view a.png is not valid"),
        ("PINHOLE 120 inf 72 56", "lens of view a.png is not valid"),
        ("PINHOLE 120 120 nan 56", "lens of view a.png is not valid"),
    ],
)
def test_lenses_that_cannot_be_undistorted_are_refused(lens, message, tmp_path, imported):
    folder = scene_of(lens_of("PINHOLE", 0), tmp_path / "in")
    world.write_colmap(folder / "sparse/0", lens, (WIDTH, HEIGHT), POSES, POINTS)
    with pytest.raises(HilsplatError, match=message):
        imported(folder)


def test_undistorted_pictures_have_at_most_the_longest_side(tmp_path, imported):
    camera = lens_of("OPENCV_FISHEYE", 0)
    views, *_ = imported(scene_of(camera, tmp_path / "in"), max_side_px=128)
    assert {max(view.camera.width, view.camera.height) for view in views} == {128}
    world.require_right(views, POSES, 28)
