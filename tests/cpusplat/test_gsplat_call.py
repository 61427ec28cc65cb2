"""`rasterization` on arrays: shapes, render modes, errors, threads, and what is imported."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import cpusplat
from cpusplat import rasterization
from tests.cpusplat.scenes import HEIGHT, WIDTH, random_gaussians, two_cameras

STRAIGHT = {
    "viewmats": np.eye(4)[None],
    "Ks": np.array([[[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]]),
    "width": 32,
    "height": 24,
}


def one_gaussian(**changes: object) -> dict:
    """A round white Gaussian of scale 0.1 and opacity 0.8, on the optical axis at depth 2."""
    arrays = {
        "means": [[0, 0, 2]],
        "quats": [[1, 0, 0, 0]],
        "scales": [[0.1, 0.1, 0.1]],
        "opacities": [0.8],
        "colors": [[1, 1, 1]],
    }
    return {name: np.array(values, np.float32) for name, values in (arrays | changes).items()} | STRAIGHT


def test_a_gaussian_on_the_axis_has_its_closed_form():
    colors, alphas, meta = rasterization(**one_gaussian())
    # variance (30 px x 0.1 / 2)^2 + 0.3; the pixel (16.5, 12.5) is at a squared distance of 0.5 from the mean
    variance = 1.5**2 + 0.3
    assert alphas[0, 12, 16, 0] == pytest.approx(0.8 * np.exp(-0.5 * 0.5 / variance), rel=1e-5)
    np.testing.assert_allclose(colors, np.repeat(alphas, 3, axis=-1), rtol=1e-6)
    np.testing.assert_allclose(meta["means2d"], [[[16, 12]]])
    np.testing.assert_allclose(meta["depths"], [[2]])
    sigmas = min(3.33, np.sqrt(2 * np.log(0.8 * 255)))
    assert meta["radii"].tolist() == [[2 * [int(np.ceil(sigmas * np.sqrt(variance)))]]]
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (32, 24, 1)


@pytest.mark.parametrize(("opacity", "scale"), [(1.0, 0.1), (1.0, 0.0), (0.0, 0.1)])
def test_opacities_and_scales_may_have_their_extreme_values(opacity, scale):
    # the pixel (16, 12) has its centre at (0.5, 0.5) from the mean
    _, alphas, _ = rasterization(**one_gaussian(opacities=[opacity], scales=[3 * [scale]]))
    variance = (15 * scale) ** 2 + 0.3
    expected = min(opacity * np.exp(-0.25 / variance), 0.999)
    assert alphas[0, 12, 16, 0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("depth", "scale"), [(1e-22, 1.0), (1e-17, 1.0), (2.0, 1e9)])
def test_a_gaussian_that_is_far_wider_than_the_view_covers_it(depth, scale):
    huge = one_gaussian(means=[[0, 0, depth]], scales=[3 * [scale]])
    _, alphas, meta = rasterization(**huge, near_plane=0.0)
    np.testing.assert_allclose(alphas, 0.8, rtol=1e-6)
    assert (meta["radii"] == 2**31 - 1).all()


def test_near_far_and_low_pass_are_honoured():
    assert rasterization(**one_gaussian(), near_plane=2.1)[1].max() == 0
    assert rasterization(**one_gaussian(), far_plane=1.9)[1].max() == 0
    _, alphas, _ = rasterization(**one_gaussian(), eps2d=1.0)
    assert alphas[0, 12, 16, 0] == pytest.approx(0.8 * np.exp(-0.25 / (1.5**2 + 1)), rel=1e-5)


@pytest.mark.parametrize(("mode", "channels"), [("RGB", 5), ("D", 1), ("ED", 1), ("RGB+D", 6), ("RGB+ED", 6)])
def test_render_modes(mode, channels):
    gaussians, cameras = random_gaussians(60, channels=5), two_cameras()
    backgrounds = np.full((2, 5), 0.5, np.float32)
    colors, alphas, _ = rasterization(**gaussians, **cameras, render_mode=mode, backgrounds=backgrounds)
    assert colors.shape == (2, HEIGHT, WIDTH, channels) and alphas.shape == (2, HEIGHT, WIDTH, 1)
    assert colors.dtype == alphas.dtype == np.float32
    plain, same_alphas, _ = rasterization(**gaussians, **cameras)
    np.testing.assert_array_equal(alphas, same_alphas)
    if "RGB" in mode:
        np.testing.assert_array_equal(colors[..., :5], plain + (1 - alphas) * np.float32(0.5))
    if "D" in mode:
        depth, _, _ = rasterization(**gaussians, **cameras, render_mode="D")
        expected = depth / alphas.clip(1e-10) if "ED" in mode else depth
        np.testing.assert_array_equal(colors[..., -1:], expected)
        inside = alphas[..., 0] > 0.5
        mean = (depth / alphas.clip(1e-10))[inside]
        assert mean.min() > 0.01 and mean.max() < 8


def test_colours_may_differ_between_views():
    gaussians, cameras = random_gaussians(60), two_cameras()
    both = np.stack([gaussians["colors"], 2 * gaussians["colors"]])
    colors, _, _ = rasterization(**gaussians | {"colors": both}, **cameras)
    plain, _, _ = rasterization(**gaussians, **cameras)
    np.testing.assert_array_equal(colors[0], plain[0])
    np.testing.assert_allclose(colors[1], 2 * plain[1], rtol=1e-6, atol=1e-7)


def test_no_gaussians_render_the_background():
    gaussians = {name: values[:0] for name, values in random_gaussians(1).items()}
    colors, alphas, _ = rasterization(**gaussians, **two_cameras(), backgrounds=np.ones((2, 3)))
    assert (colors == 1).all() and (alphas == 0).all()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"absgrad": True}, NotImplementedError, "absgrad = True is not supported, only False"),
        ({"packed": True}, NotImplementedError, "packed = True"),
        ({"rasterize_mode": "antialiased"}, NotImplementedError, "rasterize_mode = 'antialiased'"),
        ({"camera_model": "fisheye"}, NotImplementedError, "camera_model = 'fisheye'"),
        ({"radius_clip": 3.0}, NotImplementedError, "radius_clip = 3.0"),
        ({"rolling_shutter": "GLOBAL"}, NotImplementedError, "rolling_shutter"),
        ({"backgrounds": np.ones(3)}, ValueError, r"backgrounds has the shape \[3\]; expected \[1, 3\]"),
        ({"covars": np.eye(3)}, NotImplementedError, "covars"),
        ({"tile_sise": 8}, TypeError, "tile_sise"),
        ({"render_mode": "depth"}, ValueError, "render_mode is 'depth'; expected one of RGB, D, ED"),
        ({"quats": np.zeros((1, 4))}, ValueError, "1 of 1 Gaussians"),
        ({"means": np.full((1, 3), np.nan)}, ValueError, "1 of 1 Gaussians"),
        ({"scales": np.full((1, 3), -1)}, ValueError, "scales must not be negative"),
        ({"opacities": np.array([1.5])}, ValueError, "opacities must be from 0 to 1"),
        ({"opacities": np.zeros((1, 1))}, ValueError, r"opacities has the shape \[1, 1\]; expected \[1\]"),
        ({"viewmats": np.eye(4)}, ValueError, r"viewmats has the shape \[4, 4\]; expected \[any, 4, 4\]"),
        ({"sh_degree": 1, "colors": np.zeros((1, 1, 3))}, ValueError, "sh_degree is 1 with 1 harmonics"),
        ({"sh_degree": 4, "colors": np.zeros((1, 25, 3))}, ValueError, "sh_degree is 4"),
        ({"sh_degree": 0.5, "colors": np.zeros((1, 1, 3))}, TypeError, "float"),
        ({"viewmats": np.full((1, 4, 4), np.nan)}, ValueError, "viewmats and Ks must be finite"),
        ({"Ks": np.diag([0.0, 30, 1])[None]}, ValueError, "focal lengths above 0"),
        ({"viewmats": np.eye(4)[:0].reshape(0, 4, 4), "Ks": np.zeros((0, 3, 3))}, ValueError, "one view"),
        ({"width": 32.5}, TypeError, "float"),
        ({"height": 0}, ValueError, "height of at least 1"),
        ({"eps2d": -0.3}, ValueError, "eps2d of at least 0"),
    ],
    ids=lambda value: "" if not isinstance(value, dict) else next(iter(value)),
)
def test_what_is_not_supported_is_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        rasterization(**one_gaussian() | arguments)


def test_lists_of_numbers_are_arrays():
    arrays = one_gaussian()
    lists = {name: values.tolist() for name, values in arrays.items() if isinstance(values, np.ndarray)}
    for by_list, by_array in zip(rasterization(**arrays | lists), rasterization(**arrays), strict=True):
        np.testing.assert_equal(by_list, by_array)


RENDER_AFTER_FORK = """
import os, sys, threading
from tests.cpusplat.scenes import random_gaussians, two_cameras
from cpusplat import rasterization
scene = {**random_gaussians(60), **two_cameras(), "threads": 2}
image = rasterization(**scene)[0]
child = os.fork()
if not child:
    threading.Timer(60, os._exit, [1]).start()
    os._exit(0 if (rasterization(**scene)[0] == image).all() else 2)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


def test_a_process_forked_after_rendering_renders_too():
    root = Path(cpusplat.__file__).parents[1]
    subprocess.run([sys.executable, "-c", RENDER_AFTER_FORK], cwd=root, check=True, timeout=120)


def test_arguments_that_affect_only_speed_are_accepted():
    rasterization(**one_gaussian(), tile_size=8, channel_chunk=4, segmented=True)


def test_the_package_imports_only_numpy_and_numba_and_lazily():
    for path in Path(cpusplat.__file__).parent.glob("*.py"):
        statements = list(ast.walk(ast.parse(path.read_text())))
        names = [alias.name for node in statements if isinstance(node, ast.Import) for alias in node.names]
        names += [node.module for node in statements if isinstance(node, ast.ImportFrom)]
        allowed = {*sys.stdlib_module_names, "cpusplat", "numpy", "numba", "llvmlite"}
        allowed |= {"torch"} if path.name == "torch_call.py" else set()
        assert {name.partition(".")[0] for name in names} <= allowed, path.name
    command = "import sys, cpusplat; assert 'numba' not in sys.modules; cpusplat.rasterization; "
    command += "assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", command], check=True)


def test_all_public_names_exist():
    assert all(callable(getattr(cpusplat, name)) for name in cpusplat.__all__)
    with pytest.raises(AttributeError, match="no attribute 'rasterize'"):
        _ = cpusplat.rasterize
