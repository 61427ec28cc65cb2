"""The evaluate and figures stages, and the scores of labels of published data sets."""

import json

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.errors import MisalignedArtifactError, SceneError
from hilsplat.base.images import read_image, write_png
from hilsplat.base.levels import Level
from hilsplat.base.tables import read_csv
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.registry import open_labelled
from hilsplat.evaluate.costs import TIME_COLUMNS
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.figures import panel
from hilsplat.evaluate.protocols.view_truth import ViewTruth, truths_of
from hilsplat.settings import EvaluateSettings, FiguresSettings
from tests.unit.evaluate.builders import box, region_of


def test_only_test_views_are_scored_and_evaluating_twice_gives_the_same_bytes(opened, tmp_path):
    scores = opened.evaluate(tmp_path / "scores.csv")
    assert set(scores["view"]) == {"001.png"}
    assert set(scores["masks"]) == {"sam-tiny"}
    assert set(scores["method"]) == {"field", "tree", "tree-path", "truth"}
    times = read_csv(tmp_path / "times.csv", TIME_COLUMNS, "")
    assert [row["method"] for row in times] == ["field", "tree"]
    assert all(float(row["seconds"]) > 0 for row in times)
    opened.evaluate(tmp_path / "two.csv")
    assert (tmp_path / "scores.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()
    assert len(opened.evaluate(tmp_path / "none.csv", truth=None)) == 0  # no annotations


def test_the_panel_is_written_with_the_pictures_of_poses_and_fit_beside_it(opened, tmp_path):
    for number, path in enumerate((opened.parts.scene / "registration.png", tmp_path / "fit/test_views.png")):
        path.parent.mkdir(exist_ok=True)
        write_png(path, np.full((20, 30, 3), 100 * number, np.uint8))
    out, settings = tmp_path / "panel.webp", FiguresSettings(queries_per_level=1)
    given = {"fit": tmp_path / "fit", "truth": opened.truth}
    panel.run_figures(opened.parts, out, settings, EvaluateSettings(), **given)
    with Image.open(out) as picture:
        assert (picture.width, picture.format) == (1430, "WEBP")
    for number, name in enumerate(("registration", "fit")):
        copied = read_image(tmp_path / f"{name}.webp")
        assert copied.shape == (20, 30, 3) and np.abs(copied.astype(int) - 100 * number).max() <= 2


def labelled(block_world, views=("001.png",), levels=True):
    """Labels equal to the block world's annotations, with or without levels."""
    annotations = block_world.annotations
    regions = []
    for node in annotations.nodes:
        place = (Level(node.level), annotations.path_of(node.id)) if levels else ()
        regions.append(region_of(annotations.mask("001.png", [node.id]), node.text, *place))
    return LabelledScene("hi_lerf", "blocks", {}, None, dict.fromkeys(views, tuple(regions)))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        *[("canonical", ("bear",)), ("filter_px", 20), ("relevancy_threshold", 0.9), ("threshold_on", "raw")],
        *[("majority", False), ("node_select", 0), ("min_region_px", 300)],
    ],
)
def test_rows_of_one_name_have_the_same_scores_under_all_settings(opened, tmp_path, setting, value):
    def scored(settings):
        return opened.evaluate(tmp_path / "scores.csv", settings, source="world:tabletop:1")

    usual, changed = scored(EvaluateSettings()), scored(EvaluateSettings(**{setting: value}))
    assert not usual.drop(columns="protocol").equals(changed.drop(columns="protocol"))
    of_usual, of_changed = (
        {names: rows.to_csv(index=False) for names, rows in frame.groupby(["method", "protocol"])}
        for frame in (usual, changed)
    )
    shared = of_usual.keys() & of_changed.keys()
    assert {names: of_usual[names] for names in shared} == {names: of_changed[names] for names in shared}


@pytest.fixture
def rows(opened, monkeypatch, tmp_path):
    """Function that evaluates the block world and returns its scores."""

    def evaluate(labels=None):
        monkeypatch.setattr(
            ExtraProtocols, "open", staticmethod(lambda name, data_root: (name, labels, ExtraProtocols()))
        )
        given = {"truth": None, "labels": ["lerf"]} if labels else {}
        return opened.evaluate(tmp_path / "scores.csv", dataset="lerf", **given)

    return evaluate


def test_labels_give_the_scores_of_the_same_annotations_and_flat_ones_those_of_lerf(block_world, rows):
    annotated = rows()
    assert len(annotated) > 50
    assert rows(labelled(block_world)).equals(annotated)
    flat = rows(labelled(block_world, ("000.png", "001.png"), levels=False))  # a training view, too
    assert {protocol.split("@")[0] for protocol in flat["protocol"]} == {"lerf/langsplat", "lerf/tree-nodes"}
    of_lerf = annotated[annotated["protocol"].str.startswith("lerf/")]
    assert set(flat["view"]) == {"000.png", "001.png"}
    held_out = flat[flat["view"] == "001.png"]
    assert held_out.reset_index(drop=True).equals(of_lerf.reset_index(drop=True))


def test_annotations_of_scenes_with_one_name_in_two_data_sets_are_scores_of_two_scenes(opened, tmp_path):
    folder = tmp_path / "annotated/lerf/blocks"
    folder.mkdir(parents=True)
    square = [[8, 8], [40, 8], [40, 40], [8, 40]]
    bear = {"category": "bear", "segmentation": square, "bbox": [8, 8, 40, 40], "level": 1, "id": 1}
    labels = {"info": {"width": 64, "height": 64, "name": "001.jpg"}, "objects": [bear]}
    (folder / "001.json").write_text(json.dumps(labels))
    (folder.parents[1] / "lerf_mask").symlink_to(folder.parent)
    for data in ("lerf", "lerf_mask"):
        own = {"labels": [f"annotated/{data}/blocks"], "data_root": tmp_path, "truth": None}
        scores = opened.evaluate(tmp_path / "scores.csv", dataset=data, **own)
        assert {*scores["dataset"]} == {"annotated"} and {*scores["scene"]} == {f"{data}/blocks"}


def test_labelled_views_without_pose_and_labels_of_another_shape_are_refused(block_world, rows):
    with pytest.raises(SceneError, match=r"have no pose: 007\.png\n"):
        rows(labelled(block_world, views=("001.png", "007.png")))
    wide = region_of(np.ones((64, 80), bool), "bear")
    scene = LabelledScene("lerf_ovs", "blocks", {}, None, {"001.png": (wide,)})
    with pytest.raises(MisalignedArtifactError, match=r"label of view 001.png does not match"):
        rows(scene)


def test_regions_of_one_text_are_merged_and_keep_their_boxes():
    left, right = box((1, 3), (0, 2), (4, 6)), box((0, 2), (4, 6), (4, 6))
    given = region_of(right, "paw", boxes=np.array([[4, 0, 5, 3]]))
    nowhere = region_of(np.zeros((4, 6), bool), "ring")
    truth = ViewTruth.of_regions([region_of(left, "paw"), given, nowhere], (4, 6))
    (paw,), (ring,) = truth.categories, truth.absent
    assert not truth.queries and paw.level is None
    assert np.array_equal(paw.truth, left | right)
    assert paw.boxes_xyxy.tolist() == [[0, 1, 1, 2], [4, 0, 5, 3]]  # extent, and as annotated
    assert ring.text == "ring"


def test_a_region_with_a_broken_chain_is_queried_but_belongs_to_no_family():
    mask = np.ones((4, 6), bool)
    bear = region_of(mask, "bear", Level.WHOLE)
    head = region_of(mask, "head", Level.PART, ("bear", "head"))
    tail = region_of(mask, "tail", Level.PART, ("tail",))
    truth = ViewTruth.of_regions([bear, head, tail], (4, 6))
    assert [query.text for query in truth.queries] == ["bear", "head", "tail"]
    assert truth.families() == [[(("bear",), [("bear", "head")])], []]


def test_labels_shrink_as_public_evaluators_shrink_them():
    # OpenCV's nearest takes the pixel under the corner; at an eighth, Pillow takes the one under the centre.
    mask = np.zeros((48, 48), bool)
    mask[0::3, 0::3] = True
    (dots,) = ViewTruth.of_regions([region_of(mask, "dots")], (16, 16), (34, 44)).categories
    assert dots.truth.all()
    small = Image.fromarray(mask).resize((5, 4), Image.Resampling.NEAREST)
    np.testing.assert_array_equal(dots.eighth, np.asarray(small))


def test_an_eighth_is_that_of_the_image_also_if_poses_shrank_it(block_world, tmp_path):
    mask = np.random.default_rng(0).random((128, 128)) < 0.5
    write_png(tmp_path / "001.png", np.zeros((128, 128, 3), np.uint8))
    images, regions = {"001.png": tmp_path / "001.png"}, (region_of(mask, "dots"),)
    known = LabelledScene("3d_ovs", "blocks", images, None, {"001.png": regions})
    (dots,) = truths_of(known, block_world.scene, 0)["001.png"]().categories
    assert dots.truth.shape == (64, 64)
    small = Image.fromarray(mask).resize((16, 16), Image.Resampling.NEAREST)
    np.testing.assert_array_equal(dots.eighth, np.asarray(small))


def test_labels_on_points_are_refused_where_images_are_needed(tmp_path):
    with pytest.raises(SceneError, match="on points"):
        open_labelled("scannet/scene0000_00", tmp_path)
