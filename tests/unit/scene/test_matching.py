"""Matches equal a comparison of every descriptor with every other; pairs are verified like COLMAP's."""

import numpy as np
import pytest

from hilsplat.scene import matching
from hilsplat.scene.colmap import pycolmap


def descriptors_of(directions):
    """SIFT's form of non-negative directions: bytes of length 512, or nearly."""
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    return np.minimum(np.round(512 * directions / lengths), 255).astype(np.uint8)


def view_of(descriptors):
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 400.0, 400, 300)
    columns = np.ascontiguousarray(descriptors.T ^ np.uint8(128)).view(np.int8)
    return matching.ViewFeatures(1, camera, np.zeros((len(descriptors), 2)), descriptors, columns)


def two_views(rng, shared, alone):
    """Two views that share features, up to noise and order, and have others."""
    directions = rng.exponential(1, (shared, 128))
    views = []
    for order in (np.arange(shared), rng.permutation(shared)):
        seen = np.maximum(directions[order] + rng.normal(0, 0.2, (shared, 128)), 0)
        views.append(view_of(descriptors_of(np.concatenate([seen, rng.exponential(1, (alone, 128))]))))
    return views


def compared_one_by_one(one, other):
    """The definition, descriptor by descriptor."""

    def nearest(first, second):
        found = {}
        for row, descriptor in enumerate(first.descriptors.astype(int)):
            products = second.descriptors.astype(int) @ descriptor
            order = np.argsort(-products, kind="stable")
            angles = np.arccos(np.minimum(products[order[:2]] / 512**2, 1))
            if angles[0] <= matching.MAX_ANGLE and angles[0] < matching.MAX_RATIO * angles[1]:
                found[row] = int(order[0])
        return found

    there, back = nearest(one, other), nearest(other, one)
    return [[row, column] for row, column in there.items() if back.get(column) == row]


@pytest.mark.parametrize("multiplied", ("in integers if supported", "in float32"))
def test_matches_are_the_mutual_nearest_of_all(monkeypatch, multiplied):
    if multiplied == "in float32":
        monkeypatch.setattr(matching, "_integer_products", lambda: None)
    one, other = two_views(np.random.default_rng(3), 300, 290)
    matches = matching.mutual_matches(one, other).tolist()
    assert matches == compared_one_by_one(one, other) and 200 < len(matches) <= 300


def test_a_feature_with_two_equally_near_ones_has_no_match():
    descriptors = descriptors_of(np.random.default_rng(5).exponential(1, (40, 128)))
    twice = view_of(np.concatenate([descriptors, descriptors[[7, 31]]]))
    matched = matching.mutual_matches(view_of(descriptors), twice)
    assert matched.tolist() == [[row, row] for row in range(40) if row not in (7, 31)]
    assert len(matching.mutual_matches(view_of(descriptors[:0]), twice)) == 0


def test_verified_matches_are_written(tmp_path):
    database = tmp_path / "features.db"
    rng = np.random.default_rng(8)
    descriptors = descriptors_of(rng.exponential(1, (60, 128)))
    scene = rng.uniform((-1, -1, 3), (1, 1, 5), (60, 3))
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 400.0, 400, 300)
    with pycolmap.Database.open(database) as opened:
        camera.camera_id = opened.write_camera(camera)
        for view, rows in enumerate((np.arange(60), np.arange(60), np.arange(46, 60))):
            image = opened.write_image(pycolmap.Image(f"{view}.png", camera_id=camera.camera_id))
            points = camera.img_from_cam(scene[rows] - [0.3 * view, 0.1 * view**2, 0])
            opened.write_keypoints(image, points.astype(np.float32))
            features = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors[rows])
            opened.write_descriptors(image, features)
    options = pycolmap.TwoViewGeometryOptions()
    options.min_num_inliers, options.ransac.random_seed = 12, 0
    with pycolmap.Database.open(database) as opened:
        pairs = [(0, 1), (0, 2), (1, 2)]
        assert matching.match_pairs(opened, matching.read_features(opened), pairs, options, threads=2) == [
            (0, 1)
        ]
        geometries = [opened.read_two_view_geometry(*pair) for pair in ((1, 2), (1, 3))]
    # the third shares 14, one too few
    assert [each.inlier_matches.tolist() for each in geometries] == [[[row, row] for row in range(60)], []]
