"""View consistency: two hand-made views, exact truth, and masks that disagree by a known amount."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from hilsplat.base.artifacts import read_index, write_index
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import Level
from hilsplat.datasets.hierarchy import AnnotatedNode, write_hierarchy
from hilsplat.scene.cameras import Camera
from hilsplat_world.diagnostics.world_consistency import (
    Agreement,
    Regions,
    mean_agreement,
    neighbours,
    pair_disagreement,
    run_consistency,
    shared_points,
    view_agreement,
)
from tests.unit.evaluate.builders import box, cameras_of, masks_of

HEIGHT, WIDTH, FOCAL = 6, 10, 8.0


def pose_at(x):
    """Camera pose that looks along +z from (x, 0, 0)."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return pose


K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
# A wall at depth 4: a step of 1 to the right moves it by 8 * 1 / 4 = 2 px to the left.
A, B = (Camera("", pose_at(x), K, (HEIGHT, WIDTH)) for x in (0, 1))
WALL = np.full((HEIGHT, WIDTH), 4.0, np.float32)


def test_points_of_a_wall_move_by_its_disparity():
    pixel_a, pixel_b = shared_points(A, WALL, B, WALL)
    y, x = np.divmod(pixel_a, WIDTH)
    assert np.array_equal(pixel_b, y * WIDTH + x - 2)
    # columns 0 and 1 leave B; the last row has no row below, between which and itself B is read
    assert set(x) == set(range(2, WIDTH))
    assert len(pixel_a) == (HEIGHT - 1) * 8 == 40
    few, _ = shared_points(A, WALL, B, WALL, max_points=4)  # evenly spaced
    assert few.tolist() == pixel_a[[0, 13, 26, 39]].tolist()


def test_a_slanted_wall_keeps_its_points():
    # depth 4 + x: seen in both views, a plane; its inverse depth is linear in the image
    def depth(step):
        slope = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
        return np.tile((4 + step) / (1 - slope), (HEIGHT, 1)).astype(np.float32)

    pixel_a, pixel_b = shared_points(A, depth(0.0), B, depth(1.0), tolerance=1e-5)
    assert len(pixel_a) > 20
    slope = (pixel_a % WIDTH + 0.5 - WIDTH / 2) / FOCAL
    z = 4 / (1 - slope)
    expected = np.floor(FOCAL * (slope * z - 1) / z + WIDTH / 2)
    assert np.array_equal(pixel_b % WIDTH, expected)


def test_hidden_points_the_sky_and_surfaces_behind_the_camera_are_not_shared():
    # in B something nearer (depth 2) covers columns 3 to 5 and hides the wall there
    hidden = WALL.copy()
    hidden[:, 3:6] = 2.0
    _, pixel_b = shared_points(A, WALL, B, hidden)
    # A's pixels are projected to pixel centres, where no neighbour counts
    assert set(pixel_b % WIDTH) == {0, 1, 2, 6, 7}
    sky = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    back = Camera("back", np.diag([-1.0, 1.0, -1.0, 1.0]), K, A.size_hw)
    for views in ((A, sky, B, WALL), (A, WALL, B, sky), (A, WALL, back, WALL)):
        assert len(shared_points(*views)[0]) == 0


def columns(left, right):
    return box((0, HEIGHT), (left, right), (HEIGHT, WIDTH))


def regions(*masks):
    of_level = masks_of([columns(0, WIDTH), *masks], [1, *[2] * len(masks)])
    return Regions(of_level.dense(of_level.rows_of(Level.PART)), of_level.label_map(Level.PART))


def test_two_views_by_hand():
    pixels = shared_points(A, WALL, B, WALL)  # columns 2 to 9 of A are columns 0 to 7 of B, 5 rows
    masks_a = regions(columns(2, 6), columns(6, 10))  # 20 points each
    none = regions()
    same = view_agreement(masks_a, regions(columns(0, 4), columns(4, 10)), *pixels)
    assert same == Agreement(2, 1.0, 0.0, 0.0)
    # B's border lies one column further right: 25 and 15 points. IoU 20/25 and 15/20
    moved = view_agreement(masks_a, regions(columns(0, 5), columns(5, 10)), *pixels)
    # together in A: 2 * 190 = 380; in B: 300 + 105 = 405; in both: 190 + 10 + 105 = 305; of 780 pairs
    expected = [2, (0.8 + 0.75) / 2, (380 + 405 - 2 * 305) / 780, 175 / 480]
    assert list(moved) == pytest.approx(expected)
    merged = view_agreement(masks_a, regions(columns(0, 10)), *pixels)
    assert list(merged)[:3] == pytest.approx([2, 0.5, (780 - 380) / 780])
    with_small = view_agreement(regions(columns(2, 6), columns(6, 10), columns(2, 5)), masks_a, *pixels)
    assert with_small.masks == 2  # 15 points are too few to compare
    absent = view_agreement(masks_a, none, *pixels)
    assert (absent.best_iou, absent.masks, absent.joined_disagreement) == (0, 2, 1)
    nothing = view_agreement(none, masks_a, *pixels)
    assert np.isnan(nothing.best_iou) and nothing.masks == 0


def test_pairs_agree_with_counting_them_one_by_one():
    rng = np.random.default_rng(0)
    labels_a, labels_b = rng.integers(-1, 3, 40), rng.integers(-1, 4, 40)

    def together(labels, p, q):
        return labels[p] == labels[q] != -1

    pairs = [(p, q) for p in range(40) for q in range(p)]
    differ = sum(together(labels_a, *pair) != together(labels_b, *pair) for pair in pairs)
    either = sum(together(labels_a, *pair) or together(labels_b, *pair) for pair in pairs)
    assert pair_disagreement(labels_a, labels_b) == pytest.approx((differ / len(pairs), differ / either))
    assert np.isnan(pair_disagreement(np.array([0]), np.array([0]))).all()
    assert np.isnan(pair_disagreement(np.array([-1, -1]), np.array([-1, -1]))[1])


def test_neighbours_are_the_nearest_cameras():
    cameras = cameras_of([pose_at(x) for x in (0, 1, 3)], K, A.size_hw)
    first, second, third = cameras.names
    assert neighbours(cameras, cameras.names, 1) == [(first, second), (second, first), (third, second)]
    assert len(neighbours(cameras, cameras.names, 5)) == 6


def test_means_ignore_undefined_values():
    parts = [Agreement(2, 0.5, 0.1, np.nan), Agreement(0, np.nan, 0.3, 0.4)]
    assert mean_agreement(parts) == Agreement(2, 0.5, 0.2, 0.4)


@pytest.fixture
def world(tmp_path):
    """Truth folder and exact masks of the wall in two views; its nodes are a left and a right half."""
    truth, size_hw = tmp_path / "truth", (12, 20)
    # with twice the pixels, a step of 1 to the right moves the wall by 4 px to the left
    cameras = cameras_of([pose_at(0), pose_at(1)], np.diag([2, 2, 1]) @ K, size_hw)
    truth.mkdir()
    cameras.save(truth / "cameras.npz")
    corners = [(-9, -9, 4), (9, -9, 4), (9, 9, 4), (-9, 9, 4)]
    vertices = np.array(corners, [(axis, "f4") for axis in "xyz"])
    faces = np.array([([0, 1, 2],), ([0, 2, 3],)], [("vertex_indices", "i4", (3,))])
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    PlyData(elements).write(truth / "mesh.ply")
    nothing, labels = np.full(size_hw, -1, np.int32), {}
    for view, step in zip(cameras.names, (0, 4), strict=True):
        is_right = np.tile(np.arange(20) + step > 11, (12, 1))
        labels[view] = {Level.WHOLE: is_right.astype(np.int32), Level.PART: nothing, Level.SUBPART: nothing}
        masks_of([~is_right, is_right], [1, 1]).save(tmp_path / "masks" / f"{view}.npz")
    nodes = [AnnotatedNode(0, 1, -1, "left"), AnnotatedNode(1, 1, -1, "right")]
    write_hierarchy(truth, nodes, labels, dict.fromkeys(cameras.names, range(2)))
    index = {view: {} for view in cameras.names}
    write_index(tmp_path / "masks", index, scene="synthetic/w", segmenter="graph", model=None)
    return tmp_path


def test_the_table_has_rows_for_masks_and_true_regions(world):
    text = run_consistency(world / "truth", world / "masks", world / "out.csv", 1)
    lines = (world / "out.csv").read_text().splitlines()[1:]
    for name, found in (("graph", lines[:3]), ("true regions", lines[3:])):
        assert found == [
            f"synthetic/w,{name},whole,2,4,1.0000,0.0000,0.0000",
            f"synthetic/w,{name},part,2,0,nan,0.0000,nan",
            f"synthetic/w,{name},subpart,2,0,nan,0.0000,nan",
        ]
    assert "| synthetic/w | graph | whole | 2 |" in text


def test_masks_of_another_size_and_single_views_are_refused(world, tmp_path):
    index = read_index(world / "masks")
    small = masks_of([np.ones((32, 32), bool)], [1])
    for view in index["views"]:
        small.save(tmp_path / f"{view}.npz")
    for views, error, message in (
        (index["views"], MisalignedArtifactError, r"12 x 20(.|\n)*32 x 32"),
        ({"000.png": {}}, ArtifactError, "at least two"),
    ):
        write_index(tmp_path, views, scene="s", segmenter="graph", model=None)
        with pytest.raises(error, match=message):
            run_consistency(world / "truth", tmp_path, tmp_path / "out.csv", 1)
