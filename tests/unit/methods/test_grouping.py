"""Grouping baselines: losses worked by hand or by plain loops, and groups known by construction."""

import inspect
import types

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.methods import laga, omniseg3d, vch
from hilsplat.methods.common import groups
from hilsplat.methods.common.groups import (
    clusters,
    features_of_groups,
    group_latents,
    group_means,
    thresholds_of,
)
from hilsplat.methods.common.pixels import LabelledView, labelled_views
from hilsplat.methods.common.training import product, train, unit
from hilsplat.methods.gaussian_grouping import mask_identities, neighbour_loss
from hilsplat.methods.omniseg3d import hierarchical_loss, patches
from hilsplat.methods.opengaussian import contrast_loss, instances, smoothing_loss
from hilsplat.methods.registry import method_of
from hilsplat.methods.vch import components, neighbouring_pixels, triplets, ultrametric
from hilsplat.settings import MethodSettings
from tests.unit.methods.two_boxes_inputs import two_boxes_inputs
from tests.unit.two_boxes_world import HEIGHT, REGIONS, WIDTH, region_mask

RNG = np.random.default_rng(0)
EVERY, LARGE = tuple(range(len(REGIONS))), (0, 1, 2, 3, 5, 6)
"""LARGE lacks part "B top", which covers too little of its box to be distinguished from the rest."""
FITS = {
    # method: settings, regions that it finds, least share of a region's Gaussians with its code
    "opengaussian": ({"codebook": (2, 2)}, EVERY, 0.8),
    "gaussian_grouping": ({"steps": 100}, EVERY, 0.8),
    "laga": ({}, EVERY, 0.8),
    "legaussians": ({"rate": 0.02}, EVERY, 0.8),
    "saga": ({}, (0, 1, 2, 3), 0.6),
    "omniseg3d": ({"thresholds": (0.05, 0.4, 0.7)}, LARGE, 0.6),
    "vch": ({"steps": 100, "thresholds": (0.8, 0.5, 0.3)}, LARGE, 0.6),  # a third of "A top" is a subpart
}


def fit_of(name, inputs, **changed):
    """Features of a method."""
    own = {"steps": 150, "rate": 0.05, "pixel_step": 1, **FITS[name][0], **changed}
    return method_of(name).fit(inputs, MethodSettings(name=name, **own), 0)


@pytest.mark.parametrize("name", sorted(FITS))
def test_regions_of_every_level_get_their_own_code(two_boxes_contributions, monkeypatch, name):
    monkeypatch.setattr(laga, "LEAST_MASKS", 3)  # some regions have masks in three of the four views
    features = fit_of(name, two_boxes_inputs(*two_boxes_contributions))
    _, rows, least = FITS[name]
    for row in rows:
        inside = np.flatnonzero(region_mask(row).ravel())
        own = features[inside, Level(REGIONS[row][1]).index]
        right = (own.argmax(axis=1) == row) & (own.max(axis=1) > 0.5)
        assert np.mean(right) > least, REGIONS[row][0]


@pytest.mark.parametrize("name", sorted(FITS))
def test_a_fit_repeats_to_the_byte_on_any_number_of_threads(two_boxes_contributions, name):
    before = torch.get_num_threads()
    made = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            made.append(fit_of(name, two_boxes_inputs(*two_boxes_contributions, threads), steps=5))
    finally:
        torch.set_num_threads(before)
    assert made[0].tobytes() == made[1].tobytes()
    assert made[0].shape == (HEIGHT * WIDTH, 3, len(REGIONS)) and made[0].dtype == np.float32


@pytest.mark.parametrize(
    ("method", "wrong", "direction"),
    [(omniseg3d, (0.9, 0.7, 0.5), "grow"), (vch, (0.1, 0.2, 0.2), "fall")],
)
def test_thresholds_out_of_order_are_refused(method, wrong, direction):
    settings = MethodSettings(name=method.METHOD.name, thresholds=wrong)
    with pytest.raises(
        SettingsError, match=rf"method.thresholds: {settings.name} .*\n.*numbers that {direction}"
    ):
        thresholds_of(settings, method.THRESHOLDS)


def one_view(weights, labels, size_hw):
    """Stand-in inputs with one view."""
    return types.SimpleNamespace(
        contributions=types.SimpleNamespace(views=("a",), rows_of_views=lambda: [np.arange(1)]),
        view_weights=lambda view: sp.csr_matrix(np.float32(weights)[:, None]),
        view_labels=lambda view: labels,
        view_camera=lambda view: types.SimpleNamespace(size_hw=size_hw),
    )


def test_views_without_labelled_pixels_are_refused():
    inputs = one_view([1, 1], np.full((2, 3), -1, np.int32), (1, 2))
    with pytest.raises(ArtifactError, match="no train view has a pixel on a grid of 3 px"):
        inspect.unwrap(labelled_views)(inputs, 3)


def test_labelled_pixels_know_their_place_and_are_covered():
    # 2 x 3 pixels: 0 not labelled, 4 not covered
    labels = np.full((6, 3), 0, np.int32)
    labels[0] = -1
    inputs = one_view([1, 1, 1, 1, 0, 1], labels, (2, 3))
    (view,) = inspect.unwrap(labelled_views)(inputs, 2)  # columns 0 and 2 of row 0
    assert view.xy.tolist() == [[2, 0]]
    (view,) = inspect.unwrap(labelled_views)(inputs, 1)
    assert view.xy.tolist() == [[1, 0], [2, 0], [0, 1], [2, 1]]
    assert view.chosen(np.array([3, 0])).xy.tolist() == [[2, 1], [1, 0]]


def test_gradient_of_the_sparse_product_is_that_of_the_dense_one():
    matrix = sp.random(5, 4, 0.6, "csr", np.float64, np.random.default_rng(1))
    features = torch.from_numpy(RNG.random((4, 3))).requires_grad_()
    assert torch.autograd.gradcheck(lambda given: product(matrix, given), (features,))
    assert torch.allclose(product(matrix, features), torch.from_numpy(matrix.toarray()) @ features)


def test_training_finds_the_mean_of_what_a_gaussian_shows_and_visits_all_views():
    weights, xy = sp.csr_matrix(np.ones((2, 1), np.float32)), np.zeros((2, 2), int)
    views = [LabelledView(n, np.arange(3), weights, np.full((2, 3), n, np.int32), xy) for n in range(3)]
    feature, seen = torch.zeros(1, 1, requires_grad=True), []

    def loss(view, random, done):
        seen.append((view.number, done))
        return (product(view.weights, feature) - 0.5).square().mean()

    train(views, [{"params": [feature], "lr": 0.05}], loss, MethodSettings(name="vch", steps=300), 0)
    assert feature.item() == pytest.approx(0.5, abs=1e-3)
    assert {number for number, _ in seen[:3]} == {0, 1, 2} and seen[150][1] == 0.5


@pytest.mark.parametrize(("most", "expected"), [(3, 3), (5, 5), (9, 5)])
def test_a_step_sees_some_pixels_of_a_view_each_once(most, expected):
    matrix = sp.csr_matrix(np.eye(5, dtype=np.float32))
    xy = np.stack([np.arange(5)] * 2, axis=1)
    view = LabelledView(0, np.arange(1), matrix, np.zeros((5, 3), np.int32), xy)
    feature, seen = torch.zeros(5, 1, requires_grad=True), []

    def loss(view, random, done):
        seen.append(view.xy[:, 0].tolist())
        return product(view.weights, feature).sum()

    settings = MethodSettings(name="saga", steps=20)
    train([view], [{"params": [feature], "lr": 0.1}], loss, settings, 0, most)
    assert {len(set(pixels)) for pixels in seen} == {len(pixels) for pixels in seen} == {expected}
    assert {pixel for pixels in seen for pixel in pixels} == set(range(5))


def test_smoothing_is_the_mean_distance_to_the_mean_of_the_mask():
    # mask 0: distances 1 and 3 from its mean, mask 1: 2; mask 2 has no pixel and does not count
    rendered = torch.tensor([[1.0, 0], [3.0, 0], [0.0, 2]])
    means = torch.tensor([[0.0, 0], [0.0, 0], [9.0, 9]])
    assert smoothing_loss(rendered, means, torch.tensor([0, 0, 1])).item() == pytest.approx((2 + 2) / 2)


def test_contrast_weighs_the_closest_masks_most():
    # on a line at 0, 1, 3: squares 1, 9, 4; from each mask the closest weighs 1, the farthest 0.55, later 0.1
    means = torch.tensor([[0.0], [1.0], [3.0]])
    for done, far in ((0.0, 0.55), (0.5, 0.1)):
        every = (1 / 2 + far / 10) + (1 / 2 + far / 5) + (1 / 5 + far / 10)
        assert contrast_loss(means, done).item() == pytest.approx(every / 6)
    assert contrast_loss(means[:2], 0.5).item() == pytest.approx(1 / 2)  # of two masks each is the closest
    # with a fourth mask the ranks weigh 0.4, 0.7 and 1 at first, then 0.1, 0.1 and 1
    means = torch.tensor([[0.0], [1.0], [3.0], [100.0]])
    first, later = contrast_loss(means, 0.0).item(), contrast_loss(means, 0.5).item()
    middle = 1 / 10 + 1 / 5 + 1 / 10 + 1 / (99**2 + 1)
    farthest = 1 / (100**2 + 1) + 1 / (99**2 + 1) + 1 / (97**2 + 1) + 1 / (100**2 + 1)
    assert first - later == pytest.approx((0.6 * middle + 0.3 * farthest) / 12, rel=1e-3)
    assert contrast_loss(means[:1], 0.0).item() == 0


def test_codebooks_split_by_position_first_and_by_feature_then():
    means = np.zeros((40, 3), np.float32)
    means[20:, 0] = 10
    features = np.zeros((40, 6), np.float32)
    features[::2, 1] = 1
    leaf = instances(features, means, (2, 2), 0)
    kinds = leaf.reshape(2, 10, 2)
    assert all(len(np.unique(kinds[side, :, turn])) == 1 for side in (0, 1) for turn in (0, 1))
    assert len(np.unique(leaf)) == 4


@pytest.mark.parametrize(
    ("least", "views", "num_views", "far", "expected"),
    [
        (0.2, 1, 2, None, 1.5),  # mask 0 wins view 0, mask 2 is alone in view 1
        (0.2, 1, 2, 0, 3.5),  # with mask 0 far in features, mask 1 wins view 0
        (0.7, 1, 2, None, 1.0),  # the IoU of mask 2 is too small
        (0.2, 3, 2, None, 1.5),  # both of two views are as good as three
        (0.2, 3, 3, None, 0.0),  # two of three views are not
    ],
)
def test_a_group_takes_the_best_mask_of_each_view(monkeypatch, least, views, num_views, far, expected):
    monkeypatch.setattr(groups, "MIN_SCORE", least)
    monkeypatch.setattr(groups, "MIN_VIEWS", views)
    # view 0: mask 0 holds both Gaussians of group 0 (IoU 1), mask 1 one of them; view 1: mask 2, IoU 2/3
    contributions = types.SimpleNamespace(
        matrix={"S": sp.csr_matrix(np.float32([[1, 1, 0], [1, 0, 0], [1, 1, 1]]))}.get,
        mass=lambda: np.ones((num_views, 3), np.float32),
        view=np.array([0, 0, 1]),
    )
    codes, rows = np.float32([[1], [5], [2]]), np.arange(3)
    closeness = lambda mask, group: np.where(mask == far, 0.1, 1.0)  # noqa: E731
    found = inspect.unwrap(group_latents)(np.array([0, 0, -1]), 2, contributions, rows, codes, closeness)
    assert found.tolist() == [[expected], [0.0]]


def test_means_of_groups_are_zero_where_a_group_is_empty():
    means, counts = group_means(np.float32([[1, 2], [3, 4], [5, 7]]), np.array([2, 0, 2]), 4)
    assert means.tolist() == [[3, 4], [0, 0], [3, 4.5], [0, 0]] and counts.tolist() == [1, 0, 2, 0]


def test_gaussians_without_a_group_get_nothing():
    assert features_of_groups(np.array([1, -1]), np.float32([[1], [2]])).tolist() == [[2], [0]]


def test_identities_link_the_masks_of_a_region_over_views(two_boxes_contributions):
    inputs = two_boxes_inputs(*two_boxes_contributions)
    for level in LEVELS:
        rows = inputs.contributions.rows_of(level)
        identity = mask_identities(inputs.contributions, level, 1)
        region = inputs.latents[rows].argmax(axis=1)
        assert len(np.unique(np.stack([identity, region]), axis=1).T) == len(np.unique(region))


def test_neighbours_that_agree_cost_nothing_and_others_their_divergence():
    logits = torch.tensor([[0.0, 0.0]])
    assert neighbour_loss(logits, logits[:, None], 2).item() == pytest.approx(0)
    others = torch.log(torch.tensor([[[0.25, 0.75]]]))
    expected = 0.5 * np.log(0.5 / 0.25) + 0.5 * np.log(0.5 / 0.75)
    assert neighbour_loss(logits, others, 2).item() == pytest.approx(expected / 2)


def test_patches_share_the_masks_that_hold_both():
    labels = np.repeat(np.int32([[0, 2, 4], [0, 2, 5], [0, 3, -1], [1, -1, -1]]), 3, axis=0)
    labels = np.concatenate([labels, np.int32([[0, -1, -1]])])  # a patch of one pixel is left out
    patch, shared = patches(labels)
    assert patch.tolist() == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3 + [-1]
    assert shared.tolist() == [[3, 2, 1, 0], [2, 3, 1, 0], [1, 1, 2, 0], [0, 0, 0, 1]]


def test_hierarchical_loss_matches_a_plain_loop_over_pixels():
    labels = np.repeat(np.int32([[0, 2, 4], [0, 2, 5], [0, 3, -1], [1, -1, -1]]), 4, axis=0)
    patch, shared = patches(labels)
    rendered = unit(torch.from_numpy(RNG.normal(size=(16, 3)).astype(np.float32)))
    found = hierarchical_loss(rendered, torch.from_numpy(patch), torch.from_numpy(shared)).item()
    x = rendered.numpy().astype(np.float64)
    means = np.stack([x[patch == k].mean(axis=0) for k in range(4)])
    phi = [np.clip(10 * np.linalg.norm(x[patch == k] - means[k], axis=1).mean(), 0.5, 1.0) for k in range(4)]
    prototypes = means / np.linalg.norm(means, axis=1, keepdims=True)
    losses = {0: [], 1: [], 2: []}
    for pixel, own in enumerate(patch):
        logits = x[pixel] @ prototypes.T / phi
        surprise = np.log(np.exp(logits).sum()) - logits
        floor = surprise[own]
        losses[0].append(floor)
        for step in (1, 2):
            near = [
                k
                for k in range(4)
                if k != own and shared[own, k] and max(shared[own, own] - shared[own, k], 1) == step
            ]
            if near:
                floor = np.mean([max(surprise[k], floor) for k in near])
                losses[step].append(floor)
    expected = sum(0.2**step * np.mean(values) for step, values in losses.items())
    assert found == pytest.approx(expected, rel=1e-5)


def test_clusters_of_higher_thresholds_lie_inside_those_of_lower_ones():
    # two pairs of directions: 20 degrees apart inside a pair, 90 between pairs
    angle = np.deg2rad([0, 20, 90, 110]).repeat(5)
    features = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    found = clusters(features, (0.0, 0.8, 0.99), 0)
    assert [len(np.unique(level)) for level in found.T][1:] == [2, 4]
    for coarse, fine in ((0, 1), (1, 2)):
        assert len(np.unique(found[:, [coarse, fine]], axis=0)) == len(np.unique(found[:, fine]))


def minimax(length, edges, start, end):
    """Least over paths of the longest edge, by adding edges from the shortest."""
    part = list(range(1 + max(max(edge) for edge in edges)))
    for k in np.argsort(length, kind="stable"):
        a, b = edges[k]
        part = [part[a] if p == part[b] else p for p in part]
        if part[start] == part[end]:
            return length[k]
    return 2.0


def test_ultrametric_is_the_least_longest_edge_of_any_path():
    vectors = torch.from_numpy(RNG.normal(size=(12, 3)))
    edges = np.array([(a, b) for a in range(12) for b in range(a + 1, 12) if RNG.random() < 0.3]).T
    pairs = np.array([(a, b) for a in range(12) for b in range(12)]).T
    found = ultrametric(vectors, edges, np.zeros(edges.shape[1]), pairs).numpy()
    length = np.linalg.norm(vectors.numpy()[edges[0]] - vectors.numpy()[edges[1]], axis=1)
    expected = [0.0 if a == b else minimax(length, edges.T.tolist(), a, b) for a, b in pairs.T]
    assert found == pytest.approx(np.array(expected), abs=1e-6)


def test_ultrametric_keeps_to_the_tree_that_borders_choose_and_has_the_slope_of_its_edge():
    # pixels 0 - 1 - 2, and a short way 0 - 2 over a border
    vectors = torch.tensor([[0.0], [1.0], [0.4]], dtype=torch.float64, requires_grad=True)
    edges, pairs = np.array([[0, 1, 0], [1, 2, 2]]), np.array([[0], [2]])
    inside = ultrametric(vectors, edges, np.array([0.0, 0.0, 10.0]), pairs)
    assert inside.item() == pytest.approx(1.0)  # over pixel 1, the longer edge 0 - 1
    assert ultrametric(vectors, edges, np.zeros(3), pairs).item() == pytest.approx(0.4)
    inside.sum().backward()
    assert vectors.grad.ravel().tolist() == pytest.approx([-1.0, 1.0, 0.0])


def test_pixels_without_a_path_are_two_apart():
    vectors = torch.zeros(3, 2)
    found = ultrametric(vectors, np.array([[0], [1]]), np.zeros(1), np.array([[0, 0, 2], [2, 1, 2]]))
    assert found.tolist() == pytest.approx([2, 0, 0], abs=1e-5)


def test_triplets_leave_a_mask_but_not_its_parent():
    # one row of pixels: whole 0 holds parts 1 and 2; pixel 5 is outside
    labels = np.full((6, 3), -1, np.int32)
    labels[:5, 0], labels[:2, 1], labels[2:4, 1] = 0, 1, 2
    found = triplets(labels, np.array([1, 2, 2]), np.array([-1, 0, 0], np.int32), np.random.default_rng(0))
    whole, first, second = found.reshape(3, 3, -1).swapaxes(0, 1)
    assert set(whole[0]) == {0, 1, 2, 3, 4} and set(whole[2]) == {5}
    assert set(first[1]) == {0, 1} and set(first[2]) == {2, 3, 4}
    assert set(second[0]) == {2, 3} and set(second[2]) == {0, 1, 4}


def test_neighbouring_pixels_are_joined_once():
    edges = neighbouring_pixels(np.array([[x, 0] for x in range(20)]))
    assert (edges[0] < edges[1]).all() and len(np.unique(edges.T, axis=0)) == edges.shape[1]
    assert [0, 1] in edges.T.tolist() and [0, 19] not in edges.T.tolist()


def test_components_split_where_features_jump_and_those_beyond_the_largest_join_the_nearest(monkeypatch):
    means = np.stack([np.arange(60.0), np.zeros(60), np.zeros(60)], axis=1).astype(np.float32)
    features = np.zeros((60, 2), np.float32)
    features[:30, 0], features[30:50, 1] = 1, 1
    features[50:] = 0.8, 0.6  # 1.41 from the first to the second run, 0.89 to the third, 0.63 between these
    found = components(features, means, (1.5, 0.95, 0.1))
    assert [len(np.unique(level)) for level in found.T] == [1, 2, 3]
    assert found[0, 2] == 0 and found[30, 2] == 1 and found[50, 2] == 2  # largest first
    monkeypatch.setattr(vch, "LARGEST", 2)
    assert (components(features, means, (1.5, 0.95, 0.1))[50:, 2] == 1).all()
