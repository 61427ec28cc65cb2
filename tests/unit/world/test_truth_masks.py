"""Faults in true masks occur at their rates, and the segmenter that applies them runs only on request."""

import itertools

import numpy as np
import pytest

from hilsplat.base.artifacts import provenance_path, read_index, read_json, write_index, write_json
from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import sha256_of_path
from hilsplat.datasets.hierarchy import AnnotatedNode, write_hierarchy
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.stage import run_masks
from hilsplat.settings import MasksSettings
from hilsplat_world.settings import PerturbSettings
from hilsplat_world.stages import truth_masks
from hilsplat_world.truth_masks import (
    FAULTS,
    Draws,
    TrueNodes,
    beside,
    cut_in_two,
    displaced,
    faults_label,
    faulty_masks,
    longest_border,
    run_truth_masks,
    sibling_borders,
)
from tests.unit.segment.handmade import save_scene

EXACT = PerturbSettings(**{fault: (0, 0, 0) if fault == "missing" else 0 for fault in FAULTS}, score_noise=0)
OBJECTS = 25
WIDTH, HEIGHT = 9, 6


def row_of_objects() -> tuple[np.ndarray, TrueNodes]:
    """Objects 8 px wide, a pixel apart, each with a left and a right part that touch; the floor below.

    Ids of object k: whole 3k, parts 3k + 1 and 3k + 2; the floor comes last.
    """
    labels = np.full((3, HEIGHT, OBJECTS * WIDTH), -1, np.int32)
    nodes = []
    for k in range(OBJECTS):
        left = k * WIDTH
        labels[0, :4, left : left + 8] = 3 * k
        labels[1, :4, left : left + 4] = 3 * k + 1
        labels[1, :4, left + 4 : left + 8] = 3 * k + 2
        nodes.append(AnnotatedNode(3 * k, 1, -1, "cup"))
        nodes += [AnnotatedNode(3 * k + i, 2, 3 * k, side) for i, side in ((1, "left"), (2, "right"))]
    floor = len(nodes)
    labels[0, 4:] = floor
    nodes.append(AnnotatedNode(floor, 1, -1, "floor"))
    return labels, TrueNodes.of(tuple(nodes), {floor}, [labels])


LABELS, TRUTH = row_of_objects()


def with_faults(view="000.png", min_area_px=1, **faults):
    settings = EXACT.model_copy(update=faults)
    return faulty_masks(LABELS, TRUTH, view, Draws(0, "set/scene"), settings, min_area_px)


def regions(masks, level) -> set[bytes]:
    return {mask.tobytes() for mask in masks.dense(masks.rows_of(level))}


def true_regions(level, skip=(), labels=LABELS) -> set[bytes]:
    of_level = labels[level.index]
    return {(of_level == node).tobytes() for node in np.unique(of_level) if node >= 0 and node not in skip}


def binomial(trials: int, probability: float):
    """The expected number, with four standard deviations: wrong once in 16,000."""
    sigma = np.sqrt(trials * probability * (1 - probability))
    return pytest.approx(trials * probability, abs=4 * sigma)


def test_small_regions_give_no_mask():
    masks, _ = with_faults(min_area_px=17)  # parts have 16 px, wholes 32
    assert len(masks.rows_of(Level.PART)) == 0
    assert len(masks.rows_of(Level.WHOLE)) == OBJECTS + 1


def test_only_siblings_have_common_borders():
    borders = sibling_borders(LABELS[1], TRUTH)
    assert borders[1] == {2: 4} and borders[2] == {1: 4}
    assert sibling_borders(LABELS[0], TRUTH) == {}  # the floor touches every object
    assert TRUTH.partner == {node: node + (1 if node % 3 == 1 else -1) for node in borders}
    assert longest_border({7: 3, 5: 9, 4: 9}) == 4


@pytest.mark.parametrize(
    ("fault", "settings", "trials", "probability"),
    [
        ("merged", {"merge": 0.2}, OBJECTS, 0.36),  # either part may start it: 1 - 0.8^2 of the pairs
        ("missing", {"missing": (0.1, 0.0, 0.0)}, OBJECTS + 1, 0.1),
        ("missing", {"missing": (0.0, 0.5, 0.0)}, 2 * OBJECTS, 0.5),
        ("split", {"split": 0.3}, 3 * OBJECTS + 1, 0.3),
        ("wrong_level", {"wrong_level": 0.2}, 3 * OBJECTS + 1, 0.2),
    ],
)
def test_faults_occur_at_their_rates(fault, settings, trials, probability):
    views = [with_faults(f"{view:03d}.png", **settings) for view in range(12)]
    counts = sum(counts[fault] for _, counts in views)
    assert counts == binomial(12 * trials, probability)
    if fault == "missing":
        assert sum(3 * OBJECTS + 1 - len(masks) for masks, _ in views) == counts


def test_a_merged_mask_covers_both_parts():
    masks, counts = with_faults(merge=1)
    assert counts["merged"] == OBJECTS
    assert regions(masks, Level.PART) == true_regions(Level.WHOLE, skip=TRUTH.background)
    assert regions(masks, Level.WHOLE) == true_regions(Level.WHOLE)
    # a merged mask has 32 px, the part it stands for 16
    assert masks.predicted_iou[masks.rows_of(Level.PART)] == pytest.approx(0.5)
    assert masks.stability[masks.rows_of(Level.PART)] == pytest.approx(0.75)


def test_a_cut_leaves_between_30_and_70_percent_on_either_side():
    mask = np.zeros((40, 50), bool)
    mask[5:35, 10:40] = True
    for seed in range(20):
        first, second = cut_in_two(mask, np.random.default_rng(seed))
        assert np.array_equal(first ^ second, mask)
        assert 0.25 < first.sum() / mask.sum() < 0.75
    single = np.zeros((3, 3), bool)
    single[1, 1] = True
    assert len(cut_in_two(single, np.random.default_rng(0))) == 1


def test_a_wrong_level_is_one_step_away():
    masks, _ = with_faults(wrong_level=1)
    # Every whole becomes a part; about half of the parts become wholes, the others subparts.
    assert len(masks.rows_of(Level.PART)) == OBJECTS + 1
    assert len(masks.rows_of(Level.WHOLE)) == binomial(2 * OBJECTS, 0.5)
    assert len(masks.rows_of(Level.WHOLE)) + len(masks.rows_of(Level.SUBPART)) == 2 * OBJECTS
    assert [beside(Level.SUBPART, up) for up in (True, False)] == [Level.PART, Level.PART]


@pytest.mark.parametrize(
    ("fault", "level", "rate"),
    [
        ("merge", Level.WHOLE, 0.36),  # drawn for each of the two parts: 1 - 0.8^2; their union is the whole
        ("missing", Level.PART, 0.2),
    ],
)
def test_a_systematic_fault_repeats_in_its_share_of_the_views(fault, level, rate):
    views, of_level = 25, LABELS[level.index]
    nodes = sorted(set(np.unique(of_level).tolist()) - {-1} - TRUTH.background)
    found = np.zeros(len(nodes), int)
    for view in range(views):
        parts = regions(with_faults(f"{view:03d}.png", **{f"systematic_{fault}": 0.2})[0], Level.PART)
        found += [(of_level == node).tobytes() in parts for node in nodes]
    times = found if fault == "merge" else views - found
    assert 0 < (times > 0).sum() < len(nodes)
    assert (times > 0).sum() == binomial(len(nodes), rate)
    # A pair whose parts are both drawn merges more often, never less: four deviations below 0.9.
    assert (times[times > 0] >= 0.9 * views - 4 * np.sqrt(views * 0.09)).all()


def test_a_higher_probability_only_adds_faults():
    few = regions(with_faults(missing=(0, 0.1, 0))[0], Level.PART)
    many = regions(with_faults(missing=(0, 0.4, 0))[0], Level.PART)
    assert many < few < true_regions(Level.PART)


@pytest.mark.parametrize("seed", range(5))
def test_a_larger_amplitude_lowers_the_iou_and_changes_more_pixels(seed):
    y, x = np.mgrid[:96, :96] - 47.5
    mask = x**2 + y**2 < 25**2
    rough = [displaced(mask, a, 6, np.random.default_rng(seed)) for a in (0, 0.5, 1, 2, 4, 8)]
    assert np.array_equal(rough[0], mask)
    ious = [(mask & each).sum() / (mask | each).sum() for each in rough]
    assert (np.diff(ious) < 0).all()
    for less, more in itertools.pairwise(rough):  # what a small amplitude changed, a large one does
        assert not ((less ^ mask) & ~(more ^ mask)).any()


def test_the_standard_deviation_of_a_boundary_is_the_amplitude():
    mask = np.zeros((64, 64), bool)
    mask[:, :32] = True
    shifts = [displaced(mask, 2.0, 6.0, np.random.default_rng(seed)).sum(axis=1) - 32 for seed in range(100)]
    # the mean of 100 x about 5 independent places; rounding to pixels adds 1/12 to the variance of 4,
    # clipping at three deviations takes 1 % of it
    assert np.std(shifts) == pytest.approx(2.0, rel=0.1)
    assert abs(np.mean(shifts)) < 0.3
    assert np.abs(shifts).max() <= 6


def test_thin_masks_do_not_vanish_and_a_mask_of_the_whole_view_is_unchanged():
    bar = np.zeros((32, 32), bool)
    bar[16, 4:28] = True
    for seed in range(10):
        assert (displaced(bar, 8, 3, np.random.default_rng(seed)) & bar).sum() == 24
    full = np.ones((16, 16), bool)
    assert displaced(full, 4, 3, np.random.default_rng(0)).all()


NAMES = ("000.png", "001.png", "002.png")


def shifted(view: int) -> np.ndarray:
    """Labels of a view, shifted so that views differ."""
    return np.roll(LABELS, view, axis=2)


@pytest.fixture
def world(tmp_path):
    """A posed scene, its last view for testing, and its truth."""
    black = np.zeros((*LABELS.shape[1:], 3), np.uint8)
    save_scene(tmp_path / "scene", dict.fromkeys(NAMES, black), test=NAMES[-1:])
    labels = {name: dict(zip(LEVELS, shifted(view), strict=True)) for view, name in enumerate(NAMES)}
    write_hierarchy(tmp_path / "truth", TRUTH.nodes, labels, dict.fromkeys(NAMES, range(len(TRUTH.nodes))))
    write_json(tmp_path / "truth" / "scene.json", {"background": sorted(TRUTH.background)})
    write_index(tmp_path / "truth", {name: {} for name in NAMES})
    return tmp_path


def make(world, out="masks", settings=EXACT, threads=1):
    run_truth_masks(world / "scene", world / "truth", world / out, settings, 1, threads)
    return world / out


def test_without_faults_every_true_region_of_every_training_view_is_a_mask(world):
    folder = make(world)
    index = read_index(folder)
    assert list(index["views"]) == ["000.png", "001.png"]
    for view, name in enumerate(NAMES[:2]):
        masks = HierarchicalMasks.load(folder / f"{name}.npz")
        for level in LEVELS:
            assert regions(masks, level) == true_regions(level, labels=shifted(view))
        assert len(masks) == 3 * OBJECTS + 1 and index["views"][name]["whole"] == OBJECTS + 1
        assert (masks.predicted_iou == 1).all() and (masks.stability == 1).all()
        assert not any(index["views"][name]["faults"].values())


def test_the_same_faults_give_the_same_bytes_on_any_number_of_threads(world):
    settings = PerturbSettings(merge=0.5, split=0.5, boundary_px=2.0)
    folders = [make(world, f"masks-{threads}", settings, threads) for threads in (1, 3)]
    assert sha256_of_path(folders[0]) == sha256_of_path(folders[1])
    other = make(world, "masks-other", settings.model_copy(update={"seed": 7}))
    assert sha256_of_path(other) != sha256_of_path(folders[0])
    index = read_index(other)
    assert (index["segmenter"], index["model"]) == ("truth-perturbed", None)
    assert index["label"] == "truth-perturbed (seed 7, boundary_px 2.0, merge 0.5, split 0.5)"
    assert index["perturb"]["merge"] == 0.5


def test_labels_list_non_default_settings():
    assert faults_label(PerturbSettings()) == "truth-perturbed"
    assert faults_label(EXACT) == "truth-perturbed (exact)"
    assert faults_label(PerturbSettings(missing=(0, 0, 0.5))) == "truth-perturbed (missing 0/0/0.5)"


def test_label_images_of_the_wrong_size_are_refused(world):
    for level in LEVELS:
        write_png(world / "truth" / "labels" / f"001.png.{level.label}.png", np.zeros((12, 20), np.uint16))
    with pytest.raises(MisalignedArtifactError, match=r"view 001\.png(.|\n)*6 x 225(.|\n)*12 x 20"):
        make(world)
    assert not (world / "masks").exists()


def test_the_stage_records_the_truth_and_the_faults(world):
    settings = MasksSettings(segmenter="truth-perturbed", min_area_px=1)
    truth_masks(world / "scene", world / "truth", world / "out", settings, PerturbSettings(seed=3))
    record = read_json(provenance_path(world / "out"))
    assert record["stage"] == "truth_masks" and record["settings"]["perturb"]["seed"] == 3
    assert set(record["inputs"]) == {"scene", "truth"}


def test_the_stage_of_other_segmenters_refuses_the_diagnostic_one(world):
    settings = MasksSettings(segmenter="truth-perturbed")
    with pytest.raises(SettingsError, match="needs a generated scene's ground truth"):
        run_masks(world / "scene", world / "out", world / "cache", settings, 1)
    assert not (world / "out").exists()
