"""Faults in true masks occur at their rates, and systematic faults repeat across views."""

import itertools

import numpy as np
import pytest

from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.synthetic.hierarchy import AnnotatedNode
from hilsplat.settings import PerturbSettings
from hilsplat.world.mask_faults import (
    Draws,
    TrueNodes,
    beside,
    cut_in_two,
    displaced,
    faulty_masks,
    longest_border,
    sibling_borders,
)
from hilsplat.world.truth_masks import FAULTS

EXACT = PerturbSettings(
    **{fault: (0, 0, 0) if fault.startswith("missing") else 0 for fault in FAULTS}, score_noise=0
)
OBJECTS = 25
WIDTH, HEIGHT = 9, 6


def row_of_objects(objects: int = OBJECTS) -> tuple[np.ndarray, TrueNodes]:
    """Objects 8 px wide, a pixel apart, each with a left and a right part that touch; the floor below.

    Ids of object k: whole 3k, parts 3k + 1 and 3k + 2; the floor comes last.
    """
    labels = np.full((3, HEIGHT, objects * WIDTH), -1, np.int32)
    nodes = []
    for k in range(objects):
        left = k * WIDTH
        labels[0, :4, left : left + 8] = 3 * k
        labels[1, :4, left : left + 4] = 3 * k + 1
        labels[1, :4, left + 4 : left + 8] = 3 * k + 2
        nodes += [
            AnnotatedNode(3 * k, 1, -1, "cup"),
            AnnotatedNode(3 * k + 1, 2, 3 * k, "left"),
            AnnotatedNode(3 * k + 2, 2, 3 * k, "right"),
        ]
    floor = len(nodes)
    labels[0, 4:] = floor
    nodes.append(AnnotatedNode(floor, 1, -1, "floor"))
    return labels, TrueNodes.of(tuple(nodes), {floor}, [labels])


LABELS, TRUTH = row_of_objects()


def with_faults(view="000.png", seed=0, min_area_px=1, **faults):
    settings = EXACT.model_copy(update=faults)
    return faulty_masks(LABELS, TRUTH, view, Draws(seed, "set/scene"), settings, min_area_px)


def regions(masks, level) -> set[bytes]:
    return {mask.tobytes() for mask in masks.dense(masks.rows_of(level))}


def true_regions(level, skip=()) -> set[bytes]:
    of_level = LABELS[level.index]
    return {(of_level == node).tobytes() for node in np.unique(of_level) if node >= 0 and node not in skip}


def within_binomial_bounds(successes: int, trials: int, probability: float) -> bool:
    """Four standard deviations: wrong once in 16,000."""
    sigma = np.sqrt(trials * probability * (1 - probability))
    return abs(successes - trials * probability) <= 4 * sigma


def test_without_faults_the_masks_are_the_true_regions():
    masks, counts = with_faults()
    for level in LEVELS:
        assert regions(masks, level) == true_regions(level)
    assert len(masks) == 3 * OBJECTS + 1
    assert (masks.predicted_iou == 1).all()
    assert (masks.stability == 1).all()
    assert not any(counts.values())


def test_the_background_setting_omits_the_surroundings():
    masks, _ = with_faults(background=False)
    assert regions(masks, Level.WHOLE) == true_regions(Level.WHOLE, skip=TRUTH.background)


def test_small_regions_give_no_mask():
    masks, _ = with_faults(min_area_px=17)  # parts have 16 px, wholes 32
    assert len(masks.rows_of(Level.PART)) == 0
    assert len(masks.rows_of(Level.WHOLE)) == OBJECTS + 1


def test_only_siblings_have_common_borders():
    borders = sibling_borders(LABELS[1], TRUTH)
    assert borders[1] == {2: 4}
    assert borders[2] == {1: 4}
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
    assert within_binomial_bounds(counts, 12 * trials, probability)
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


def test_the_pieces_of_a_split_mask_cover_it():
    masks, counts = with_faults(split=1)
    assert counts["split"] == 3 * OBJECTS + 1
    for level in (Level.WHOLE, Level.PART):
        pieces = masks.dense(masks.rows_of(level)).sum(axis=0)
        assert np.array_equal(pieces, (LABELS[level.index] >= 0).astype(int))


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
    assert within_binomial_bounds(len(masks.rows_of(Level.WHOLE)), 2 * OBJECTS, 0.5)
    assert len(masks.rows_of(Level.WHOLE)) + len(masks.rows_of(Level.SUBPART)) == 2 * OBJECTS
    assert [beside(Level.SUBPART, up) for up in (True, False)] == [Level.PART, Level.PART]


def test_views_and_levels_are_dropped_at_their_rates():
    labels, truth = row_of_objects(1)
    settings = EXACT.model_copy(update={"dropped_views": 0.25, "missing_level": (0.0, 0.4, 0.0)})
    draws = Draws(0, "set/scene")
    dropped = without_parts = 0
    for view in range(150):
        masks, counts = faulty_masks(labels, truth, f"{view:03d}.png", draws, settings, 1)
        dropped += counts["dropped"]
        without_parts += counts["missing_levels"]
        expected = 0 if counts["dropped"] else 2 if counts["missing_levels"] else 4
        assert len(masks) == expected
    assert within_binomial_bounds(dropped, 150, 0.25)
    assert within_binomial_bounds(without_parts, 150, 0.75 * 0.4)


def times_found(views: int, parts: list[np.ndarray], **faults) -> np.ndarray:
    """Number of views in which each region is the mask of a part."""
    found = [regions(with_faults(f"{view:03d}.png", **faults)[0], Level.PART) for view in range(views)]
    return np.array([sum(part.tobytes() in masks for masks in found) for part in parts])


def test_a_systematic_merge_repeats_in_its_share_of_the_views():
    views = 25
    merged = times_found(views, [LABELS[0] == 3 * k for k in range(OBJECTS)], systematic_merge=0.2)
    assert 0 < (merged > 0).sum() < OBJECTS
    # drawn once for each of the two parts: 1 - 0.8^2
    assert within_binomial_bounds(int((merged > 0).sum()), OBJECTS, 0.36)
    # a pair of which both parts are drawn merges more often, never less: four deviations below 0.9
    assert (merged[merged > 0] >= 0.9 * views - 4 * np.sqrt(views * 0.09)).all()


def test_a_systematically_missing_node_is_missing_in_its_share_of_the_views():
    views = 25
    parts = [LABELS[1] == node for node in range(3 * OBJECTS) if node % 3]
    seen = times_found(views, parts, systematic_missing=0.2)
    faulty = seen < views
    assert within_binomial_bounds(int(faulty.sum()), 2 * OBJECTS, 0.2)
    assert (seen[faulty] <= 0.1 * views + 4 * np.sqrt(views * 0.09)).all()


def test_a_higher_probability_only_adds_faults():
    few = regions(with_faults(missing=(0, 0.1, 0))[0], Level.PART)
    many = regions(with_faults(missing=(0, 0.4, 0))[0], Level.PART)
    assert many < few < true_regions(Level.PART)


def test_faults_depend_only_on_seed_scene_and_view():
    settings = PerturbSettings()

    def content(view, draws):
        masks, _ = faulty_masks(LABELS, TRUTH, view, draws, settings, 1)
        return b"".join(array.tobytes() for array in masks.arrays().values())

    forth, back = Draws(3, "set/scene"), Draws(3, "set/scene")
    first, second = content("a.png", forth), content("b.png", forth)
    assert content("b.png", back) == second != first == content("a.png", back)
    for other in (Draws(4, "set/scene"), Draws(3, "set/other")):
        assert content("a.png", other) != first


def test_chances_are_uniform():
    draws = Draws(0, "set/scene")
    values = np.array([draws.chance("coin", number) for number in range(4000)])
    assert values.min() >= 0
    assert values.max() < 1
    for low in np.arange(0, 1, 0.1):
        assert within_binomial_bounds(int(((values >= low) & (values < low + 0.1)).sum()), 4000, 0.1)


def disc(radius: float, side: int = 96) -> np.ndarray:
    y, x = np.mgrid[:side, :side] + 0.5 - side / 2
    return x**2 + y**2 < radius**2


def iou(a, b) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.parametrize("seed", range(5))
def test_a_larger_amplitude_lowers_the_iou_and_changes_more_pixels(seed):
    mask = disc(25)
    amplitudes = [0, 0.5, 1, 2, 4, 8]
    rough = [displaced(mask, a, 6, np.random.default_rng(seed)) for a in amplitudes]
    assert np.array_equal(rough[0], mask)
    ious = [iou(mask, each) for each in rough]
    assert all(more < less for less, more in itertools.pairwise(ious))
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
