"""Predictions of any program from files: the same scores as the run that wrote them, and clear errors."""

import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import hilsplat
from hilsplat.base.errors import ArtifactError, HilsplatError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.base.tables import read_csv
from hilsplat.datasets.classes import SCANNET_10, SCANNET_19
from hilsplat.datasets.labelled import LabelledScene
from hilsplat.datasets.points.labelled_points import LabelledPoints, PointScene
from hilsplat.evaluate.extra_protocols import ExtraProtocols
from hilsplat.evaluate.files_stage import run_evaluate_files
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import LEVEL_AUTO, card_of
from hilsplat.evaluate.protocols.view_truth import ViewTruth
from hilsplat.evaluate.protocols.views import given_key, measure_view
from hilsplat.evaluate.scores import read_instances, read_scores
from hilsplat.evaluate.tables.build import published_values, run_table
from hilsplat.evaluate.tables.rows import PUBLISHED_COLUMNS
from hilsplat.settings import EvaluateSettings
from tests.unit.evaluate.builders import box, region_of

VIEW = "001.png"
SETTINGS = EvaluateSettings(methods=("tree",))


def write_answers(folder, world, packed=False):
    """Write the tree's answers in the view, at levels and one per text, and return the rows of a run."""
    truth = ViewTruth.of(world.annotations, VIEW, (64, 64), SETTINGS.min_region_px)
    kept, selections = PackedMasks((64, 64)), Selections(world.answers)
    rows = list(measure_view(selections, truth, VIEW, kept, SETTINGS, ExtraProtocols()))
    masks = {query.text: kept.get(("tree", LEVEL_AUTO.name, query.text)) for query in truth.categories}
    for query in truth.queries:
        masks[f"{query.level.label}/{query.text}"] = kept.get(given_key("tree", query))
    if packed:
        folder.mkdir(parents=True)
        np.savez(folder / "001.npz", **masks)
    else:
        for name, mask in masks.items():
            write_png(folder / "001" / f"{name}.png", mask.astype(np.uint8) * 255)
    return rows


def score(world, predictions, out, **more):
    given = {"truth": world.folder / "truth", "scene": world.folder / "scene", "name": "blocks", **more}
    run_evaluate_files(predictions, out, method="theirs", **given)
    return read_scores([out])


def numbers(frame, protocol, metrics):
    kept = frame[frame["protocol"].str.startswith(protocol) & frame["metric"].isin(metrics)]
    return {(row.query, row.level, row.metric): row.value for row in kept.itertuples()}


@pytest.mark.parametrize("packed", [False, True])
def test_files_of_our_own_run_have_the_same_scores_and_make_a_table(block_world, tmp_path, packed):
    rows = write_answers(tmp_path / "theirs", block_world, packed)
    frame = score(block_world, tmp_path / "theirs", tmp_path / "scores.csv", source="world:tabletop:1")
    flat, levelled = {"iou", "boundary_iou"}, "hierarchy/level-given"
    both = flat | {"hc_containment", "hc_literal"}
    for ours, theirs, metrics in (("lerf/tree-nodes", "lerf/langsplat", flat), (levelled, levelled, both)):
        expected = {
            (row.query, row.level, row.metric): pytest.approx(row.value, abs=1e-6)
            for row in rows
            if row.protocol.startswith(ours) and row.metric in metrics
        }
        assert len(expected) > 5
        assert numbers(frame, theirs, metrics) == expected
    assert set(frame["method"]) == {"files"}
    assert set(frame["variant"]) == {"theirs"}
    assert "lerf-mask/gaussian-grouping@1 (wholes, masks of files)" in set(frame["protocol"])
    assert "3d-ovs/argmax@3 (labelled pixels, wholes, masks of files)" in set(frame["protocol"])
    # the regions of lid and nose are smaller
    large = score(block_world, tmp_path / "theirs", tmp_path / "large.csv", min_region_px=300)
    assert set(large["query"]) == {"bear", "chest", "head", ""}
    assert large["protocol"].str.contains("(regions from 300 px, masks of files)", regex=False).all()
    published = tmp_path / "published.csv"
    published.write_text(",".join(PUBLISHED_COLUMNS) + "\n")
    run_table("lerf", [tmp_path / "scores.csv"], published, {"theirs": "Their method"}, tmp_path / "lerf.csv")
    table = (tmp_path / "lerf.md").read_text()
    assert "Their method" in table and "Their method, files" not in table


def refused(world, predictions, tmp_path, error=ArtifactError):
    with pytest.raises(error) as caught:
        score(world, predictions, tmp_path / "scores.csv")
    assert not (tmp_path / "scores.csv").exists()
    return str(caught.value)


def test_a_view_without_predictions_or_with_two_is_refused_but_its_folder_may_be_empty(block_world, tmp_path):
    assert "view 001 has no predictions" in refused(block_world, tmp_path, tmp_path)
    (tmp_path / "001").mkdir()
    frame = score(block_world, tmp_path, tmp_path / "scores.csv")  # nothing in any view
    assert len(frame) and not frame["value"].any()
    (tmp_path / "scores.csv").unlink()
    np.savez(tmp_path / "001.npz", bear=np.ones((64, 64), bool))
    assert "view 001 has two sets of predictions" in refused(block_world, tmp_path, tmp_path)


@pytest.mark.parametrize(
    ("name", "height", "value", "message"),
    [
        ("whole/bear", 32, 255, r"001.png: whole/bear: the mask .*\n.*64 x 64 \(height x width\)\n.*32 x 64"),
        ("baer", 64, 255, "the labels have no text 'baer'\n(.|\n)*rename it to .bear."),
        ("whole/nose", 64, 255, "the labels have no text 'nose' at level whole"),
        ("bear", 64, 1, "none is foreground"),
    ],
)
def test_masks_that_cannot_be_scored_are_refused(block_world, tmp_path, name, height, value, message):
    write_png(tmp_path / "001" / f"{name}.png", np.full((height, 64), value, np.uint8))
    assert re.search(message, refused(block_world, tmp_path, tmp_path, HilsplatError))


def test_masks_may_have_any_image_format_and_other_files_are_refused(data_set, tmp_path):
    cup, mug = box((2, 14), (0, 4), (16, 16)), box((2, 14), (9, 16), (16, 16))
    data_set({"a.png": (region_of(cup, "cup"), region_of(mug, "mug"))})
    (tmp_path / "a").mkdir()
    Image.fromarray(cup * np.uint8(255)).save(tmp_path / "a/cup.PNG", "PNG")
    Image.fromarray(mug * np.uint8(255)).save(tmp_path / "a/mug.jpg", quality=95)
    (tmp_path / "a/._cup.PNG").write_bytes(b"macOS")
    frame, _ = scored(tmp_path)
    assert (frame.loc[frame["metric"] == "iou", "value"] == 1).all()
    np.save(tmp_path / "a/mug.npy", mug)
    with pytest.raises(ArtifactError, match=r"a/mug.npy is not a mask"):
        scored(tmp_path)
    (tmp_path / "a/mug.npy").rename(tmp_path / "a/mug.bmp")
    with pytest.raises(ArtifactError, match=r"a/mug.bmp and \S*a/mug.jpg are two masks"):
        scored(tmp_path)


def test_exactly_one_of_labels_and_truth_is_required(tmp_path):
    for given in ({}, {"truth": tmp_path}, {"labels": "lerf_ovs/ramen", "truth": tmp_path}):
        with pytest.raises(SettingsError, match="exactly one set of labels"):
            run_evaluate_files(tmp_path, tmp_path / "scores.csv", method="m", **given)


# --- data sets ------------------------------------------------------------------------------------


@pytest.fixture
def data_set(monkeypatch):
    """Function that makes `--labels set/s` open the given labels: a `PointScene`, or regions by view."""

    def put(known, flat=(), points=()):
        if isinstance(known, dict):
            known = LabelledScene("set", "s", {}, None, known)
        extra = ExtraProtocols(*(tuple(map(card_of, names)) for names in (flat, points)))
        monkeypatch.setattr(
            ExtraProtocols, "open", staticmethod(lambda name, data_root: ("set", known, extra))
        )

    return put


def scored(folder):
    """Scores, and the printed means: protocol -> the words before it."""
    printed = run_evaluate_files(folder, folder / "scores.csv", method="m", labels="set/s").splitlines()
    end = printed[0].index("protocol")
    return read_scores([folder / "scores.csv"]), {line[end:]: line[:end].split() for line in printed}


def test_labels_of_a_data_set_take_grey_where_the_protocol_does(data_set, tmp_path):
    label, grey = box((0, 4), (0, 16), (16, 16)), box((0, 8), (0, 16), (16, 16))
    region = replace(region_of(label, "cup"), any_grey=lambda: grey)
    cards = ("3d-ovs/langsplat", "3d-ovs/langsplat-v2", "3d-ovs/argmax")
    data_set({"a.png": (region,)}, cards)
    write_png(tmp_path / "a" / "cup.png", grey.astype(np.uint8) * 255)
    frame, means = scored(tmp_path)
    ious = {row.protocol: row.value for row in frame[frame["metric"] == "iou"].itertuples()}
    assert ious["3d-ovs/langsplat-v2@3 (masks of files)"] == 1
    assert ious["3d-ovs/langsplat@2 (masks of files)"] == 0.5
    shares = numbers(frame, "lerf/opengaussian", {"acc_25", "acc_50"})
    assert shares == {("cup", "", "acc_25"): 1, ("cup", "", "acc_50"): 0}  # 0.5 is not above 0.5
    # an eighth has rows 4 and 12: the label has neither, and row 4 is in the mask
    assert ious["3d-ovs/argmax@3 (masks of files)"] == 0
    assert set(frame["scene"]) == {"s"}
    assert means["protocol"] == ["method", "mIoU", "accuracy", "queries"]
    assert means["3d-ovs/langsplat@2 (masks of files)"] == ["m", "50.0", "1"]
    assert means["3d-ovs/argmax@3 (masks of files)"] == ["m", "0.0", "50.0", "1"]


def test_labels_without_regions_are_refused(data_set, tmp_path):
    data_set({"a.png": ()})  # such as a file of proposals
    with pytest.raises(ArtifactError, match="set/s has neither a labelled region"):
        scored(tmp_path)


def point_scene(num=400, seed=0):
    rng = np.random.default_rng(seed)
    class_id = rng.choice([0, 1, 2, 3, 4, 5], num).astype(np.int32)
    places = rng.random((num, 3))
    nyu40 = LabelledPoints(places, class_id, np.ones(num, np.int32))
    fine = np.where(np.arange(num) < 150, 2, 0).astype(np.int32)  # 150 points of one chair
    return PointScene("s", (), {"nyu40": nyu40, "scannet200": replace(nyu40, class_id=fine)})


SEMANTIC = ("scannet/opengaussian-19", "scannet/opengaussian-10")


def test_class_ids_of_points_score_as_the_same_labels_in_memory(data_set, tmp_path):
    known = point_scene()
    data_set(known, points=SEMANTIC)
    predicted = np.random.default_rng(1).choice([0, 1, 2, 3, 4, 5, 40], 400)
    (tmp_path / "nyu40.txt").write_text("\n".join(map(str, predicted)), "utf-8-sig")  # as Windows writes it
    of_ten = np.full(400, SCANNET_10.ids[0])
    (tmp_path / "scannet-10.txt").write_text("\n".join(map(str, of_ten)))
    frame, _ = scored(tmp_path)
    for classes, given in ((SCANNET_19, predicted), (SCANNET_10, of_ten)):
        expected = hilsplat.score(
            given, known.truth["nyu40"].class_id, f"scannet/opengaussian-{len(classes)}"
        )
        kept = frame[frame["protocol"] == expected.protocol]
        assert {(row.query, row.metric): row.value for row in kept.itertuples()} == {
            (row["query"], row["metric"]): pytest.approx(row["value"], abs=1e-6) for row in expected.rows
        }


def test_instances_in_scannets_format_are_matched(data_set, tmp_path):
    data_set(point_scene(), points=("scannet200/instances",))
    mask = np.arange(400) < 150
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "0.txt").write_text("\n".join(map(str, mask.astype(int))))
    (tmp_path / "instances.txt").write_text("masks/0.txt 2 0.9\n\n")
    _, means = scored(tmp_path)
    assert means["scannet200/instances@1 (points: files)"] == ["m", "100.0"]
    ((key, matches),) = read_instances([tmp_path / "scores.csv"]).items()
    assert key == ("set", "s", "m", "-", "files")
    assert matches.is_match.all()
    assert matches.misses.sum() == 0
    nothing = tmp_path / "nothing"  # another program, scored to the same folder
    nothing.mkdir()
    (nothing / "instances.txt").touch()
    run_evaluate_files(nothing, tmp_path / "other.csv", method="n", labels="set/s")
    of_both = read_instances(files := [tmp_path / "scores.csv", tmp_path / "other.csv"])
    assert {key[2]: found.misses.any() for key, found in of_both.items()} == {"m": False, "n": True}
    published = published_values("scannet")
    run_table("scannet", files, published, {}, tmp_path / "scannet.csv")
    rows = [row for row in read_csv(tmp_path / "scannet.csv", None, "") if row["kind"] == "measured"]
    assert {row["method"]: row["ScanNet200 AP"] for row in rows} == {"m": "100.00", "n": "0.00"}


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("nyu40.txt", "1\n2\n", "expected  400 lines"),
        ("nyu40.txt", "chair\n" * 400, "one integer per line"),
        ("instances.txt", "only-a-mask.txt\n", "line 1 of .* does not describe an instance"),
        ("instances.txt", "nyu40.txt 2 nan\n", "line 1 of .* does not describe an instance"),
        ("instances.txt", f"nyu40.txt {10**30} 0.5\n", "line 1 of .* does not describe an instance"),
        ("instances.txt", "no.txt 2 0.9\n", "no.txt is missing"),
        ("other.txt", "1\n", "has no point labels"),
    ],
)
def test_point_files_that_cannot_be_scored_are_refused(data_set, tmp_path, name, text, message):
    data_set(point_scene(), points=(*SEMANTIC, "scannet200/instances"))
    (tmp_path / name).write_text(text)
    with pytest.raises(HilsplatError, match=message):
        scored(tmp_path)
