"""A synthetic room in the layouts of ScanNet and Replica, and a street in Waymo's, are read back equal."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hilsplat.base.artifacts import read_npz
from hilsplat.base.errors import SceneError
from hilsplat.datasets.points import replica
from hilsplat.datasets.registry import open_labels
from hilsplat.datasets.sources import export_images
from hilsplat.datasets.waymo import reader as waymo
from hilsplat.scene.poses import run_poses
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings, PosesSettings
from hilsplat.splat.initial import first_gaussians
from hilsplat_world.labels import labelled_points
from hilsplat_world.settings import WorldSettings
from hilsplat_world.stage import MESH_EDGE, run_world
from tests.unit.datasets.writers.points import (
    LabelledMesh,
    posed_images,
    write_room_as_replica,
    write_room_as_scannet,
    write_street_as_waymo,
)

IDENTITY = np.eye(4)
SETTINGS = WorldSettings(views=3, image_px=48, samples=1, objects=2)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return make_world("room", tmp_path_factory)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return make_world("street", tmp_path_factory)


def make_world(kind, tmp_path_factory):
    folder = tmp_path_factory.mktemp(kind)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(MESH_EDGE, "room", 0.5)  # a coarse mesh has a thirtieth of the vertices
        run_world(f"world:{kind}:100", SETTINGS, folder / "images", folder / "truth", threads=1)
    return folder


@pytest.fixture(scope="module")
def data_root(room, tmp_path_factory):
    """A data root with the room as a scan of ScanNet."""
    root = tmp_path_factory.mktemp("data")
    write_room_as_scannet(room, root / "scannet", "scene0000_00")
    return root


def same_images(read, true, read_from_true=IDENTITY):
    for image, view in zip(read, true, strict=True):
        np.testing.assert_allclose(image.cam_from_world @ read_from_true, view.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(image.K, view.K)
        assert image.size_hw == view.size_hw
        if not isinstance(image.image, bytes):
            assert image.image.read_bytes() == view.image.read_bytes()


def test_a_room_reads_back_equal_and_is_labelled_where_a_camera_sees_it(room, data_root, tmp_path):
    write_room_as_replica(room, tmp_path, "room_0")
    mesh, known = LabelledMesh(room), labelled_points(room, "room")
    seen = mesh.column("vertex", "views") > 0
    assert 0 < seen.sum() < len(seen)
    for scene in (open_labels("scannet/scene0000_00", data_root), replica.open_scene(tmp_path, "room_0")):
        for labelling, points in scene.truth.items():
            np.testing.assert_array_equal(points.xyz, mesh.xyz)
            np.testing.assert_array_equal(points.xyz[seen], known[labelling].xyz)
            np.testing.assert_array_equal(points.class_id[seen], known[labelling].class_id)
        same_images(scene.images, posed_images(room))
    assert known["nyu40"].xyz is known["replica"].xyz  # one search for neighbours serves all labellings


def test_frozen_gaussians_start_at_the_vertices_of_a_scan(data_root, tmp_path):
    source = tmp_path / "source"
    export_images("scannet/scene0000_00", data_root, source)
    settings = PosesSettings(test_every=0)
    run_poses(source, tmp_path / "scene", "scannet/scene0000_00", "metre", False, settings, 0, 1)
    scene = Scene.load(tmp_path / "scene")
    cameras = [scene.cameras[view] for view in scene.views("train")]
    settings = GaussiansSettings(initial="frozen", max_gaussians=100)
    gaussians = first_gaussians(scene, cameras, settings, np.random.default_rng(0))
    truth = open_labels("scannet/scene0000_00", data_root).truth["nyu40"]
    places = truth.xyz @ scene.scene_from_source[:3, :3].T + scene.scene_from_source[:3, 3]
    np.testing.assert_allclose(gaussians["means"], places, atol=1e-5)


def test_a_street_reads_back_equal_and_a_table_has_no_labelled_points(street, tmp_path):
    write_street_as_waymo(street, tmp_path / "validation", "drive")
    scene = waymo.open_segment(tmp_path, "drive")
    truth, known = scene.truth["waymo"], labelled_points(street, "street")["waymo"]
    assert len(truth) == len(known)
    # The segment's frame is that of the vehicle below its first scan, which heads along x.
    shift = read_npz(street / "truth" / "lidar.npz")["origins"][0] - np.array([1.4, 0.0, 2.2])
    # Both are the same points in different orders, up to float32 rounding.
    distance, row = cKDTree(truth.xyz + shift).query(known.xyz)
    assert distance.max() < 2e-4
    # Points of two objects can coincide only where the objects touch.
    assert (truth.class_id[row] == known.class_id).mean() > 0.9999
    assert (np.bincount(truth.class_id, minlength=23) == np.bincount(known.class_id, minlength=23)).all()
    segment_from_world = np.eye(4)
    segment_from_world[:3, 3] = -shift
    same_images(scene.images, posed_images(street), segment_from_world)
    with pytest.raises(SceneError, match="expected  room or street"):
        labelled_points(street, "tabletop")
