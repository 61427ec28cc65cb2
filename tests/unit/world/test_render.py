"""Rays have the hits of Embree, labels match analytic projection, and points have one colour in all views."""

import numpy as np
import pytest
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.ndimage import map_coordinates

from hilsplat.scene.cameras import Camera
from hilsplat_world import render
from hilsplat_world.paints import Paint
from hilsplat_world.rays import RayCaster
from hilsplat_world.scenes.kinds import scene_cameras
from hilsplat_world.scenes.scene import Style
from hilsplat_world.shapes import box, joined
from hilsplat_world.texture_kernels import fractal_noise, grains
from hilsplat_world.truth import true_depth
from hilsplat_world.views import square_camera
from tests.unit.world.scenes import built, scene_of

STONE = Paint("grey", "stone", (0.6, 0.5, 0.4), (0.3, 0.3, 0.3), 8.0, 0.0, 10.0, 0.3, (5.0, 6.0, 7.0))


def camera_at(centre, target=(0.0, 0.0, 0.0), side_px: int = 64, fov_deg: float = 50.0) -> Camera:
    return square_camera((np.array(centre), np.array(target)), side_px, fov_deg)


def test_label_image_of_a_box_is_its_analytic_projection():
    # Camera 4 in front of the face at x = 0.5 of a box of 1 x 0.6 x 0.4, focal length 100 px: the
    # near face spans 100 * 0.6 / 3.5 = 17.14 px by 100 * 0.4 / 3.5 = 11.43 px around the centre (32, 32).
    camera = camera_at((4.0, 0, 0), fov_deg=2 * np.degrees(np.arctan(32 / 100)))
    scene = scene_of(box((1.0, 0.6, 0.4)))
    x = np.arange(64) + 0.5 - 32
    expected = (np.abs(x)[None, :] < 8.571) & (np.abs(x)[:, None] < 5.714)
    labels = render.label_view(scene, camera)
    assert np.array_equal(labels[0] == 0, expected)
    assert (labels[1:] == -1).all()
    assert true_depth(scene.caster, camera)[32, 32] == pytest.approx(3.5, abs=1e-5)


def projected(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Columns and rows at which points appear, px."""
    seen = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    return ((seen @ camera.K.T)[:, :2] / seen[:, 2:]).T


def test_a_surface_point_has_one_colour_in_all_views():
    # A wide floor with a block that shadows it, seen from two sides. The same floor points are
    # compared in both images; what differs is only where the nine sub-samples of a pixel fall.
    mesh = joined(box((4, 4, 0.1), (0, 0, -0.05)), box((0.4, 0.4, 0.5), (0, 0, 0.25)))
    scene = scene_of(mesh, STONE)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 25), np.linspace(-1.2, -0.6, 25))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    found = []
    for side in (-1, 1):
        camera = camera_at((0.3 * side, -2.2, 3.0), (0.0, -0.9, 0.0), 136, 16)
        image = render.render_view(scene, camera, 3).astype(np.float64)
        # Interpolated between pixel centres, which lie at +0.5.
        column, row = projected(camera, points) - 0.5
        found.append(np.stack([map_coordinates(c, [row, column], order=1) for c in np.moveaxis(image, 2, 0)]))
    difference = np.abs(found[0] - found[1])
    assert found[0].std() > 10  # there is something to see: texture and shadow
    # A few grey values of 255 come from resampling texture that is one pixel fine.
    assert np.median(difference) < 4 and np.corrcoef(found[0].ravel(), found[1].ravel())[0, 1] > 0.93


def test_the_floor_below_a_slab_is_in_shadow():
    # Light straight above a floating slab: the floor right below is dark, far from it bright.
    mesh = joined(box((4, 4, 0.1), (0, 0, -0.05)), box((0.6, 0.6, 0.02), (0, 0, 0.8)))
    scene = scene_of(mesh, style=Style(light_position=(0.0, 0.0, 4.0)))
    camera = camera_at((2.0, 0, 0.5))
    columns, rows = projected(camera, np.array([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]])).astype(int)
    under, beside = render.render_view(scene, camera, 3)[rows, columns].mean(axis=1)
    assert under < 0.75 * beside


def test_vectorised_grain_is_bit_identical_to_fractal_noise():
    points = np.random.default_rng(0).uniform(-5, 5, (1001, 3))
    plain = [fractal_noise(*(16.0 * point), 4, 201) for point in points]
    assert np.array_equal(grains(*np.ascontiguousarray(points.T)), plain)


@pytest.mark.parametrize("samples", (2, 3))
def test_image_and_labels_do_not_depend_on_the_height_of_bands(monkeypatch, samples):
    scene = built("tabletop", objects=3)
    camera = scene_cameras(scene, 12, 48, 100.0)["005.png"]
    plain = render.render_view(scene, camera, samples), render.label_view(scene, camera)
    for rays in (1, 48 * 5 * samples**2, 10**9):
        monkeypatch.setattr(render, "BAND_RAYS", rays)
        assert all(map(np.array_equal, render.render_and_label(scene, camera, samples), plain))


def test_omitted_shadow_rays_do_not_change_the_image(monkeypatch):
    mesh = joined(box((4, 4, 0.1), (0, 0, -0.05)), box((0.6, 0.6, 0.6), (0, 0, 0.8)))
    scene = scene_of(mesh, style=Style(light_position=(1.0, 0.0, 4.0)))
    camera = camera_at((-2.0, 0, 0.9))
    image = render.render_view(scene, camera, 3)
    # Every hit then receives light and sky.
    monkeypatch.setattr(render, "receivers", lambda prim, *_: (np.flatnonzero(prim >= 0),) * 2)
    assert np.array_equal(image, render.render_view(scene, camera, 3))


def test_ring_cameras_alternate_in_elevation_and_an_arc_is_centred_on_the_front():
    scene = built("tabletop")
    cameras = scene_cameras(scene, 40, 256, 360)
    centres = np.stack([cameras[name].centre for name in cameras.names])
    azimuth = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
    # Jitter moves each by at most 1 degree.
    assert np.degrees(np.diff(azimuth)) == pytest.approx(9.0, abs=2.1)
    assert (np.diff(centres[:, 2]) * np.tile([1, -1], 20)[:39] > 0).all()
    cameras = scene_cameras(scene, 12, 128, 100.0)
    for name, end in (("000.png", -50), ("011.png", 50)):
        x, y, _ = cameras[name].centre
        assert np.degrees(np.arctan2(y, x)) == pytest.approx(end, abs=1.1)


@pytest.mark.parametrize("count", (0, 1, 15, 16, 4001))
def test_packets_have_the_hits_of_single_rays(count):
    triangles = built("tabletop", objects=3).triangles
    rng = np.random.default_rng(count)
    origins = rng.uniform(-4, 4, (count, 3)).astype(np.float32)
    targets = triangles[rng.integers(len(triangles), size=count)].mean(axis=1)
    directions = targets + rng.normal(0, 0.3, (count, 3)).astype(np.float32) - origins
    plain = EmbreeScene(robust=True)
    TriangleMesh(plain, triangles)
    single = plain.run(origins, directions, query="INTERSECT", output=True)
    hits = RayCaster(triangles).nearest(origins, directions)
    met = hits.triangle >= 0
    np.testing.assert_array_equal(met, single["primID"] >= 0)
    np.testing.assert_allclose(hits.distance[met], single["tfar"][met], rtol=1e-6)
    assert np.isinf(hits.distance[~met]).all()
    same = hits.triangle == single["primID"]
    assert same.sum() >= 0.995 * count  # where two triangles are at one distance, either is right
    for weights in ("u", "v"):
        np.testing.assert_allclose(getattr(hits, weights)[met & same], single[weights][met & same], atol=1e-5)
    is_far = np.arange(count) % 2 == 1  # of every second hit, the reach falls short
    reach = (hits.distance * np.where(is_far, 0.999, 1.001)).astype(np.float32)
    np.testing.assert_array_equal(RayCaster(triangles).blocked(origins, directions, reach), met & ~is_far)
