"""Data of the page: chunks of Gaussians, their nodes, the initial focus point."""

import gzip
from dataclasses import replace

import numpy as np
import pytest

from hilsplat.base.errors import ArtifactError
from hilsplat.viewer import payload
from hilsplat.viewer.payload import arrival_order, crossing, packed_nodes, upright
from hilsplat.viewer.viewer_scene import ViewerScene
from hilsplat.viewer.wire import MAX_BODY_BYTES, Question, Style
from tests.unit.evaluate.builders import cameras_of
from tests.unit.many_nodes import add_nodes
from tests.unit.round_gaussians import round_gaussians
from tests.unit.viewer.conftest import table

MANY = 70_000


def test_the_first_chunk_has_the_most_visible_gaussians():
    n = payload.CHUNK + 100
    rng = np.random.default_rng(1)
    scales = rng.uniform(-6, 0, n).astype(np.float32)
    gaussians = round_gaussians(rng.normal(size=(n, 3)))
    order = arrival_order(replace(gaussians, log_scales=np.repeat(scales[:, None], 3, axis=1)))
    assert sorted(order) == list(range(n))
    assert scales[order[: payload.CHUNK]].min() >= scales[order[payload.CHUNK :]].max()


def test_the_focus_is_the_point_that_the_cameras_look_at_or_in_front_of_parallel_cameras(shown):
    focus = np.array([1.0, -2.0, 3.0])
    poses = np.tile(np.eye(4), (5, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2, 5), strict=True):  # on a ring, with y down
        centre = focus + 4 * np.array([np.sin(angle), -0.3, -np.cos(angle)])
        ahead = (focus - centre) / np.linalg.norm(focus - centre)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        pose[:3, 3] = -pose[:3, :3] @ centre
    cameras = cameras_of(poses, np.diag([10.0, 10, 1]), (10, 10))
    np.testing.assert_allclose(crossing(cameras), focus, atol=0.02)
    up = upright(cameras)
    assert np.linalg.norm(up) == pytest.approx(1) and up @ [0, -1, 0] > 0.9
    cameras = shown.scene.cameras
    ahead = cameras.cam_from_world[0, 2, :3]
    assert (crossing(cameras) - cameras[cameras.names[0]].centre) @ ahead > 0


def test_more_nodes_than_16_bits_can_number(own_desk, desk):
    """The page gets the same nodes and answers, with other numbers (tests/browser compares the pictures)."""
    few = ViewerScene(desk)
    few_tree = few.answering("default").tree
    own = few_tree.node_of_gaussian[few.order]
    texels = np.frombuffer(gzip.decompress(packed_nodes(few_tree, few.order)), np.uint16).reshape(-1, 4)
    np.testing.assert_array_equal(texels[:, :3].astype(int) - 1, own)
    add_nodes(own_desk, MANY)
    shown = ViewerScene(own_desk)
    scene = shown.answering("default")
    data = gzip.decompress(packed_nodes(scene.tree, shown.order))
    nodes = np.frombuffer(data, np.uint32).reshape(len(shown.order), 4)[:, :3].astype(int) - 1
    np.testing.assert_array_equal(nodes, np.where(own >= 0, own + MANY, -1))
    (hit,) = payload.answer(scene, Question(text="mug > handle"))["hits"]
    (other,) = payload.answer(few.answering("default"), Question(text="mug > handle"))["hits"]
    assert hit == {**other, "node": other["node"] + MANY}
    table_of_hit = table(shown, {hit["node"]: (255, 122, 0, 180)})
    assert len(table_of_hit) < MAX_BODY_BYTES
    assert shown.paint("default", Style(table=table_of_hit)).share.any()


@pytest.mark.parametrize(
    ("limit", "fix"),
    [("MAX_NODES", "at most 4 nodes(.|\n)*hilsplat query"), ("MAX_GAUSSIANS", "max_gaussians")],
)
def test_a_scene_that_is_too_large_for_the_page_is_refused(desk, monkeypatch, limit, fix):
    monkeypatch.setattr(f"hilsplat.viewer.viewer_scene.{limit}", 4)
    with pytest.raises(ArtifactError, match=f"is too large for the page(.|\n)*{fix}"):
        ViewerScene(desk).answering("default")
