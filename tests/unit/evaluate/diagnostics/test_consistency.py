"""View consistency: two hand-made views, exact truth, and masks that disagree by a known amount."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import read_index, write_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode, HierarchyAnnotations, write_hierarchy
from hilsplat.evaluate.diagnostics.consistency import (
    Agreement,
    SharedPoints,
    best_ious,
    mean_agreement,
    measure_consistency,
    neighbours,
    painted,
    pair_disagreement,
    shared_points,
    thinned,
    view_agreement,
)
from hilsplat.evaluate.diagnostics.world_consistency import run_consistency, true_masks
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.world.mesh import TrueMesh
from hilsplat.world.views import looking_at, numbered_cameras, on_sphere, pinhole

HEIGHT, WIDTH, FOCAL = 6, 10, 8.0


def camera(name: str, x: float) -> Camera:
    """Looks along +z from (x, 0, 0)."""
    pose = np.eye(4)
    pose[0, 3] = -x
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return Camera(name, pose, K, (HEIGHT, WIDTH))


# A wall at depth 4: a step of 1 to the right moves it by 8 * 1 / 4 = 2 px to the left.
A, B = camera("a", 0.0), camera("b", 1.0)
WALL = np.full((HEIGHT, WIDTH), 4.0, np.float32)


def test_points_of_a_wall_move_by_its_disparity():
    points = shared_points(A, WALL, B, WALL)
    y, x = np.divmod(points.pixel_a, WIDTH)
    assert np.array_equal(points.pixel_b, y * WIDTH + x - 2)
    # columns 0 and 1 leave B; the last row has no row below, between which and itself B is read
    assert set(x) == set(range(2, WIDTH))
    assert len(points) == (HEIGHT - 1) * 8


def test_a_slanted_wall_keeps_its_points():
    # depth 4 + x: seen in both views, a plane; its inverse depth is linear in the image
    def depth(step: float) -> np.ndarray:
        slope = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
        return np.tile((4 + step) / (1 - slope), (HEIGHT, 1)).astype(np.float32)

    points = shared_points(A, depth(0.0), B, depth(1.0), tolerance=1e-5)
    assert len(points) > 20
    x = points.pixel_a % WIDTH
    slope = (x + 0.5 - WIDTH / 2) / FOCAL
    z = 4 / (1 - slope)
    expected = np.floor(FOCAL * (slope * z - 1) / z + WIDTH / 2)
    assert np.array_equal(points.pixel_b % WIDTH, expected)


def test_hidden_points_are_no_evidence():
    # in B something nearer (depth 2) covers columns 3 to 5 and hides the wall there
    hidden = WALL.copy()
    hidden[:, 3:6] = 2.0
    points = shared_points(A, WALL, B, hidden)
    columns = set(points.pixel_b % WIDTH)
    assert not columns & {3, 4, 5}
    # A's pixels land on pixel centres, where no neighbour counts
    assert columns == {0, 1, 2, 6, 7}


def test_the_sky_and_what_lies_behind_the_camera_are_no_points():
    sky = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    assert len(shared_points(A, sky, B, WALL)) == 0
    assert len(shared_points(A, WALL, B, sky)) == 0
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    assert len(shared_points(A, WALL, Camera("back", turned, A.K, A.size_hw), WALL)) == 0


def box(left: int, right: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, left:right] = True
    return mask


def test_two_views_by_hand():
    points = shared_points(A, WALL, B, WALL)  # columns 2 to 9 of A are columns 0 to 7 of B, 5 rows
    masks_a = np.stack([box(2, 6), box(6, 10)])  # 20 points each
    same = view_agreement(masks_a, np.stack([box(0, 4), box(4, 10)]), points)
    assert (same.masks, same.points) == (2, 40)
    assert (same.best_iou, same.disagreement, same.joined_disagreement) == (1, 0, 0)
    # B's border lies one column further right: 25 and 15 points. IoU 20/25 and 15/20
    moved = view_agreement(masks_a, np.stack([box(0, 5), box(5, 10)]), points)
    assert moved.best_iou == pytest.approx((0.8 + 0.75) / 2)
    # together in A: 2 * 190 = 380; in B: 300 + 105 = 405; in both: 190 + 10 + 105 = 305; of 780 pairs
    assert moved.disagreement == pytest.approx((380 + 405 - 2 * 305) / 780)
    assert moved.joined_disagreement == pytest.approx(175 / 480)


def test_merged_and_absent_masks_by_hand():
    points = shared_points(A, WALL, B, WALL)
    masks_a = np.stack([box(2, 6), box(6, 10)])
    merged = view_agreement(masks_a, box(0, 10)[None], points)
    assert merged.best_iou == pytest.approx(0.5)
    assert merged.disagreement == pytest.approx((780 - 380) / 780)
    absent = view_agreement(masks_a, np.zeros((0, HEIGHT, WIDTH), bool), points)
    assert (absent.best_iou, absent.masks) == (0, 2)
    assert absent.joined_disagreement == 1
    nothing = view_agreement(np.zeros((0, HEIGHT, WIDTH), bool), masks_a, points)
    assert np.isnan(nothing.best_iou)
    assert nothing.masks == 0


def test_pairs_agree_with_counting_them_one_by_one():
    rng = np.random.default_rng(0)
    labels_a, labels_b = rng.integers(-1, 3, 40), rng.integers(-1, 4, 40)

    def together(labels, p, q):
        return labels[p] == labels[q] != -1

    pairs = [(p, q) for p in range(40) for q in range(p)]
    differ = sum(together(labels_a, *pair) != together(labels_b, *pair) for pair in pairs)
    either = sum(together(labels_a, *pair) or together(labels_b, *pair) for pair in pairs)
    assert pair_disagreement(labels_a, labels_b) == pytest.approx((differ / len(pairs), differ / either))


def test_no_pair_of_points_has_no_share():
    assert np.isnan(pair_disagreement(np.array([0]), np.array([0]))).all()
    assert np.isnan(pair_disagreement(np.array([-1, -1]), np.array([-1, -1]))[1])


def test_small_masks_are_left_out_and_small_ones_paint_over_large_ones():
    inside = np.array([[1, 1, 1, 1], [0, 0, 1, 1], [0, 0, 0, 1]], bool)
    assert len(best_ious(inside, inside, min_points=2)) == 2
    assert painted(inside, np.array([4, 2, 1])).tolist() == [0, 0, 1, 2]
    assert painted(inside[:2], np.array([3, 3])).tolist() == [0, 0, 0, 0]


def test_points_are_thinned_evenly():
    points = SharedPoints(np.arange(100), np.arange(100))
    assert thinned(points, 100) is points
    assert thinned(points, 4).pixel_a.tolist() == [0, 33, 66, 99]


def test_neighbours_are_the_nearest_cameras():
    poses = [camera(str(x), x).cam_from_world for x in (0.0, 1.0, 3.0)]
    cameras = Cameras(
        ("0", "1", "3"), np.stack(poses), np.stack([A.K] * 3), np.tile(np.int32(A.size_hw), (3, 1))
    )
    assert neighbours(cameras, ["0", "1", "3"], 1) == [("0", "1"), ("1", "0"), ("3", "1")]
    assert len(neighbours(cameras, ["0", "1", "3"], 5)) == 6


def test_means_leave_out_what_is_undefined():
    nan = float("nan")
    mean = mean_agreement([Agreement(1, 10, 2, 0.5, 0.1, nan), Agreement(1, 20, 0, nan, 0.3, 0.4)])
    assert mean == Agreement(2, 30, 2, 0.5, 0.2, 0.4)


SIDE = 64
NODES = (
    AnnotatedNode(0, 1, -1, "table"),
    AnnotatedNode(1, 1, -1, "box"),
    AnnotatedNode(2, 2, 1, "left half"),
    AnnotatedNode(3, 2, 1, "right half"),
)


def box_on_a_table() -> np.ndarray:
    """Triangles of a table in z = 0 and of a box over |x|, |y| < 1, 0 < z < 1."""

    def square(corner, u, v):
        corner, u, v = np.array(corner, float), np.array(u, float), np.array(v, float)
        return [[corner, corner + u, corner + u + v], [corner, corner + u + v, corner + v]]

    x, y, z = np.diag([2.0, 2.0, 1.0])
    faces = [
        square([-4, -4, 0], 4 * x, 4 * y),
        square([-1, -1, 1], x, y),
        *(square(corner, step, z) for corner in ([-1, -1, 0], [1, 1, 0]) for step in (x, y)),
    ]
    faces[4:] = [square([1, 1, 0], -x, z), square([1, 1, 0], -y, z)]
    return np.concatenate(faces).astype(np.float32)


def ring_of_cameras() -> Cameras:
    """Three cameras 15 degrees apart that look down at the box."""
    poses = []
    for degrees in (20.0, 35.0, 50.0):
        centre = on_sphere(degrees, 40.0, 6.0)
        poses.append(looking_at(centre, np.array([0.0, 0.0, 0.4])))
    return numbered_cameras(poses, pinhole(SIDE, 45.0), SIDE)


def labels_at(camera: Camera, depth: np.ndarray) -> dict[Level, np.ndarray]:
    """Nodes by place: what is higher than the table is the box, its parts meet at x = 0."""
    seen = np.isfinite(depth)
    depth = np.where(seen, depth, 0.0)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    in_camera = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K).T * depth[..., None]
    world = in_camera @ camera.cam_from_world[:3, :3] + camera.centre
    is_box = seen & (world[..., 2] > 1e-3)
    halves = np.where(world[..., 0] < 0, 2, 3)
    nothing = np.full((SIDE, SIDE), -1, np.int32)
    return {
        Level.WHOLE: np.where(seen, is_box, -1).astype(np.int32),
        Level.PART: np.where(is_box, halves, -1).astype(np.int32),
        Level.SUBPART: nothing,
    }


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The box's truth folder, and its exact masks."""
    folder = tmp_path_factory.mktemp("world")
    cameras, triangles = ring_of_cameras(), box_on_a_table()
    corners = triangles.reshape(-1, 3)
    vertices = np.empty(len(corners), [(axis, "f4") for axis in "xyz"])
    for axis, values in zip("xyz", corners.T, strict=True):
        vertices[axis] = values
    faces = np.empty(len(triangles), [("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = np.arange(len(corners)).reshape(-1, 3)
    (folder / "truth").mkdir()
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements).write(folder / "truth" / "mesh.ply")
    cameras.save(folder / "truth" / "cameras.npz")
    mesh = TrueMesh.load(folder / "truth" / "mesh.ply")
    labels = {name: labels_at(cameras[name], mesh.depth(cameras[name])) for name in cameras.names}
    write_hierarchy(folder / "truth", NODES, labels, dict.fromkeys(cameras.names, range(4)))
    truth = HierarchyAnnotations.load(folder / "truth")
    for view in cameras.names:
        masks = {level: true_masks(truth, view, level) for level in LEVELS}
        level = np.repeat([int(level) for level in LEVELS], [len(masks[level]) for level in LEVELS])
        ones = np.ones(len(level), np.float32)
        HierarchicalMasks.from_dense(
            np.concatenate(list(masks.values())), level.astype(np.uint8), ones, ones
        ).save(folder / "masks" / f"{view}.npz")
    index = {view: {} for view in cameras.names}
    write_index(folder / "masks", index, scene="synthetic/w", segmenter="graph", model=None)
    return folder


def test_depth_of_the_table_and_the_box_from_above(world):
    mesh = TrueMesh.load(world / "truth" / "mesh.ply")
    above = np.diag([1.0, -1.0, -1.0, 1.0])
    above[2, 3] = 5.0  # at height 5, looking down
    depth = mesh.depth(Camera("above", above, pinhole(SIDE, 90.0), (SIDE, SIDE)))
    assert depth[32, 32] == pytest.approx(4.0)
    assert depth[32, 55] == pytest.approx(5.0)  # 23.5 px of 32 from the middle: 3.7 to the right
    assert np.isinf(depth[32, 60])  # 28.5 px: 4.5 to the right, beyond the end of the table


def interior(labels: np.ndarray) -> np.ndarray:
    """Pixels whose eight neighbours have the same label."""
    padded = np.pad(labels, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return (windows == labels[..., None, None]).all(axis=(2, 3))


def test_the_truth_disagrees_with_itself_at_borders_alone(world):
    truth = HierarchyAnnotations.load(world / "truth")
    cameras = Cameras.load(world / "truth" / "cameras.npz")
    mesh = TrueMesh.load(world / "truth" / "mesh.ply")
    depths = {view: mesh.depth(cameras[view]) for view in cameras.names}
    for a, b in neighbours(cameras, cameras.names, 1):
        points = shared_points(cameras[a], depths[a], cameras[b], depths[b])
        assert len(points) > 0.5 * SIDE * SIDE
        for level in LEVELS:
            labels_a, labels_b = truth.label_image(a, level), truth.label_image(b, level)
            at_a, at_b = labels_a.reshape(-1)[points.pixel_a], labels_b.reshape(-1)[points.pixel_b]
            inside = (
                interior(labels_a).reshape(-1)[points.pixel_a]
                & interior(labels_b).reshape(-1)[points.pixel_b]
            )
            assert inside.mean() > 0.8
            assert np.array_equal(at_a[inside], at_b[inside])
    measured = measure_consistency(
        cameras,
        neighbours(cameras, cameras.names, 1),
        depths.get,
        lambda v, level: true_masks(truth, v, level),
    )
    assert measured[Level.WHOLE].best_iou > 0.9
    assert measured[Level.WHOLE].disagreement < 0.02


def test_the_table_holds_the_masks_and_the_floor(world):
    text = run_consistency(world / "truth", world / "masks", world / "out.csv", 2)
    lines = (world / "out.csv").read_text().splitlines()
    assert len(lines) == 7
    graph, floor = lines[1:4], lines[4:]
    for ours, true in zip(graph, floor, strict=True):  # the masks are the true ones, so they cannot differ
        assert ours.split(",")[2:] == true.split(",")[2:]
    assert "| synthetic/w | graph | whole | 6 |" in text


def test_masks_of_another_size_are_refused(world, tmp_path):
    index = read_index(world / "masks")
    small = HierarchicalMasks.concatenate([], (32, 32))
    for view in index["views"]:
        small.save(tmp_path / f"{view}.npz")
    write_index(tmp_path, index["views"], scene="s", segmenter="graph", model=None)
    with pytest.raises(MisalignedArtifactError, match=r"64 x 64(.|\n)*32 x 32"):
        run_consistency(world / "truth", tmp_path, tmp_path / "out.csv", 1)


def test_one_view_has_no_neighbour(world, tmp_path):
    write_index(tmp_path, {"000.png": {}}, scene="s", segmenter="graph", model=None)
    with pytest.raises(ArtifactError, match="at least two"):
        run_consistency(world / "truth", tmp_path, tmp_path / "out.csv", 1)
