"""Labels of published data sets are scored like the annotations of a synthetic scene."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import SceneError
from hilsplat.base.levels import Level
from hilsplat.datasets.labelled import LabelledRegion, LabelledScene
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate import stage
from hilsplat.evaluate.asked import Asked
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.scores import read_scores
from hilsplat.scene.finished import SceneParts
from hilsplat.settings import EvaluateSettings


def region_of(mask, text, level=None, path=(), boxes=None):
    return LabelledRegion(text, mask.shape, lambda: mask, boxes, level, path or (text,))


def labelled(block_world, views=("001.png",), levels=True):
    """Labels that say what the block world's annotations say; without levels, flat."""
    annotations = block_world.annotations
    regions = tuple(
        region_of(
            annotations.mask("001.png", [node.id]),
            node.text,
            Level(node.level) if levels else None,
            annotations.path_of(node.id) if levels else (),
        )
        for node in annotations.nodes
    )
    return LabelledScene("hi_lerf", "blocks", {}, None, dict.fromkeys(views, regions))


@pytest.fixture
def rows(block_world, monkeypatch, tmp_path):
    """Function that evaluates the block world and returns its scores."""
    monkeypatch.setattr(
        stage, "LanguageScene", SimpleNamespace(from_parts=lambda *_, **__: block_world.answers)
    )
    folder = block_world.folder
    names = ("scene", "gaussians", "semantic_tree", "field", "autoencoder", "clip", "masks")
    parts = SceneParts(**{name: folder / name for name in names})

    def evaluate(truth=None, labels=None):
        monkeypatch.setattr(Asked, "open", staticmethod(lambda name, data_root: (name, labels, Asked())))
        stage.run_evaluate(
            parts,
            tmp_path / "scores.csv",
            EvaluateSettings(),
            dataset="lerf",
            scene="blocks",
            truth=truth,
            labels=["lerf"] if labels else [],
        )
        scores = read_scores([tmp_path / "scores.csv"])
        keys = ["view", "method", "query", "level", "metric", "protocol"]
        return scores.sort_values(keys, kind="stable").reset_index(drop=True)

    return evaluate


def test_labels_with_levels_give_the_scores_of_the_same_annotations(block_world, rows):
    annotated = rows(truth=block_world.folder / "truth")
    assert len(annotated) > 50
    assert rows(labels=labelled(block_world)).equals(annotated)


def test_flat_labels_give_the_lerf_protocols_alone(block_world, rows):
    annotated = rows(truth=block_world.folder / "truth")
    flat = rows(labels=labelled(block_world, levels=False))
    assert {protocol.split("@")[0] for protocol in flat["protocol"]} == {"lerf/langsplat", "lerf/tree-nodes"}
    of_lerf = annotated[annotated["protocol"].str.startswith("lerf/")].reset_index(drop=True)
    assert flat.equals(of_lerf)


def test_every_labelled_view_is_scored_held_out_or_not(block_world, rows):
    scores = rows(labels=labelled(block_world, views=("000.png", "001.png"), levels=False))
    assert set(scores["view"]) == {"000.png", "001.png"}


def test_labelled_views_without_pose_are_named(block_world, rows):
    with pytest.raises(SceneError, match=r"have no pose: 007\.png\n"):
        rows(labels=labelled(block_world, views=("001.png", "007.png")))


def test_labels_of_another_shape_than_the_view_are_refused(rows):
    wide = region_of(np.ones((64, 80), bool), "bear")
    scene = LabelledScene("lerf_ovs", "blocks", {}, None, {"001.png": (wide,)})
    with pytest.raises(SceneError, match=r"label of view 001.png does not fit"):
        rows(labels=scene)


def test_regions_of_one_text_unite_and_keep_their_boxes():
    left, right = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    left[1:3, 0:2], right[0:2, 4:6] = True, True
    boxes = np.array([[4, 0, 5, 3]])
    truth = ViewTruth.of_regions([region_of(left, "paw"), region_of(right, "paw", boxes=boxes)], (4, 6))
    (paw,) = truth.categories
    assert not truth.queries and paw.level is None
    assert np.array_equal(paw.truth, left | right)
    assert paw.boxes_xyxy.tolist() == [[0, 1, 1, 2], [4, 0, 5, 3]]  # extent, and as annotated


def test_regions_without_a_pixel_are_not_queries():
    truth = ViewTruth.of_regions([region_of(np.zeros((4, 6), bool), "ring")], (4, 6))
    assert truth.categories == () and [query.text for query in truth.absent] == ["ring"]


def test_a_region_with_a_broken_chain_is_queried_but_belongs_to_no_family():
    mask = np.ones((4, 6), bool)
    bear = region_of(mask, "bear", Level.WHOLE)
    head = region_of(mask, "head", Level.PART, ("bear", "head"))
    tail = region_of(mask, "tail", Level.PART, ("tail",))
    truth = ViewTruth.of_regions([bear, head, tail], (4, 6))
    assert [query.text for query in truth.queries] == ["bear", "head", "tail"]
    assert truth.families() == [[(("bear",), [("bear", "head")])], []]


def test_labels_are_resized_to_the_view():
    mask = np.zeros((4, 6), bool)
    mask[2, 3] = True
    (dot,) = ViewTruth.of_regions([region_of(mask, "dot")], (8, 12)).categories
    assert np.argwhere(dot.truth).tolist() == [[4, 6], [4, 7], [5, 6], [5, 7]]


def test_labels_shrink_as_public_evaluators_shrink_them():
    # OpenCV's nearest takes the pixel under the corner; at an eighth, Pillow takes the one under the centre.
    mask = np.zeros((48, 48), bool)
    mask[0::3, 0::3] = True
    (dots,) = ViewTruth.of_regions([region_of(mask, "dots")], (16, 16), (32, 32)).categories
    assert dots.truth.all()
    assert dots.eighth.shape == (4, 4)
    small = Image.fromarray(mask).resize((4, 4), Image.Resampling.NEAREST)
    np.testing.assert_array_equal(dots.eighth, np.asarray(small))


def test_the_answer_to_a_repeated_text_is_shared_out_by_the_annotated_wholes():
    chair, table = np.zeros((4, 6), bool), np.zeros((4, 6), bool)
    chair[:, :3], table[:, 3:] = True, True
    legs = np.zeros((4, 6), bool)
    legs[3] = True
    regions = [
        region_of(whole & part, path[-1], Level(len(path)), path)
        for name, whole in (("chair", chair), ("table", table))
        for path, part in (((name,), whole), ((name, "leg"), legs))
    ]
    truth = ViewTruth.of_regions(regions, (4, 6))
    (leg,) = [query for query in truth.queries if query.text == "leg"]
    for name, whole in (("chair", chair), ("table", table)):
        np.testing.assert_array_equal(truth.own_part((name, "leg"), leg.truth), legs & whole)
        np.testing.assert_array_equal(truth.own_part((name,), legs), legs)


@pytest.mark.parametrize(("name", "found"), [("lerf_ovs", "no scene"), ("scannet/scene0000_00", "on points")])
def test_names_without_image_labels_are_refused(tmp_path, name, found):
    with pytest.raises(SceneError, match=found):
        open_labelled(name, tmp_path)
