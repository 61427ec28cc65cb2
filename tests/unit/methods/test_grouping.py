"""Methods that group Gaussians: losses worked by hand or by plain loops, groups known by construction."""

import inspect
import json
import types

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from torch.nn.functional import cross_entropy

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.baselines import TrainedSettings
from hilsplat.configuration import parse_section
from hilsplat.field.code import LinearCode
from hilsplat.methods import laga, legaussians, saga, vch
from hilsplat.methods.common import groups
from hilsplat.methods.common.training import product, train, unit
from hilsplat.methods.gaussian_grouping import neighbour_loss
from hilsplat.methods.method import LabelledView, labelled_views
from hilsplat.methods.omniseg3d import hierarchical_loss, patches
from hilsplat.methods.opengaussian import contrast_loss, instances, smoothing_loss
from hilsplat.methods.vch import components, triplets, ultrametric

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("name", "thresholds", "direction"),
    [("omniseg3d", [0.9, 0.7, 0.5], "rise"), ("vch", [0.1, 0.2, 0.2], "fall")],
)
def test_thresholds_out_of_order_are_refused(name, thresholds, direction):
    with pytest.raises(SettingsError, match=rf"method\.thresholds: .*{direction} from whole to subpart"):
        parse_section("method", json.dumps({"name": name, "thresholds": thresholds}))


def test_labelled_pixels_are_covered_and_have_their_coordinates():
    # 2 x 3 pixels: 0 not labelled, 4 not covered
    labels = np.zeros((6, 3), np.int32)
    labels[0] = -1
    weights = {1: [1, 1, 1, 1, 0, 1], 2: [1, 0, 1, 0, 0, 0], 3: [1, 0, 0, 0, 0, 0]}  # by step
    inputs = types.SimpleNamespace(
        contributions=types.SimpleNamespace(views=("a",), rows_of_views=lambda: [np.arange(1)]),
        view_weights=lambda view, step: sp.csr_matrix(np.float32([weights[step]]).T),
        view_labels=lambda view: labels,
        view_camera=lambda view: types.SimpleNamespace(size_hw=(2, 3)),
    )
    views_of = inspect.unwrap(labelled_views)
    (view,) = views_of(inputs, 2)  # columns 0 and 2 of row 0
    assert view.xy.tolist() == [[2, 0]]
    (view,) = views_of(inputs, 1)
    assert view.xy.tolist() == [[1, 0], [2, 0], [0, 1], [2, 1]]
    assert view.chosen(np.array([3, 0])).xy.tolist() == [[2, 1], [1, 0]]
    with pytest.raises(ArtifactError, match="no training view has a labelled pixel on a 3 px grid"):
        views_of(inputs, 3)


def test_gradient_of_the_sparse_product_is_that_of_the_dense_one():
    matrix = sp.random(5, 4, 0.6, "csr", np.float64, np.random.default_rng(1))
    features = torch.from_numpy(RNG.random((4, 3))).requires_grad_()
    assert torch.autograd.gradcheck(lambda given: product(matrix, given), (features,))
    assert torch.allclose(product(matrix, features), torch.from_numpy(matrix.toarray()) @ features)


@pytest.mark.parametrize(("most", "expected"), [(3, 3), (5, 5), (9, 5)])
def test_a_step_uses_distinct_pixels_of_a_view(most, expected):
    xy = np.stack([np.arange(5)] * 2, axis=1)
    view = LabelledView(0, np.arange(1), sp.eye(5, format="csr"), np.zeros((5, 3), np.int32), xy)
    feature, seen, shares = torch.zeros(5, 1, dtype=torch.float64, requires_grad=True), [], []

    def loss(view, random, done):
        seen.append(view.xy[:, 0].tolist())
        shares.append(done)
        return product(view.weights, feature).sum()

    train([view], [feature], loss, TrainedSettings(name="saga", steps=20), 0, most)
    assert shares == [step / 20 for step in range(20)]
    assert {len(set(pixels)) for pixels in seen} == {len(pixels) for pixels in seen} == {expected}
    assert set().union(*seen) == set(range(5))


def test_smoothing_is_the_mean_distance_to_the_mean_of_the_mask():
    # mask 0: distances 1 and 3 from its mean, mask 1: 2; mask 2 has no pixel and does not count
    rendered = torch.tensor([[1.0, 0], [3.0, 0], [0.0, 2]])
    means = torch.tensor([[0.0, 0], [0.0, 0], [9.0, 9]])
    assert smoothing_loss(rendered, means, torch.tensor([0, 0, 1])).item() == pytest.approx((2 + 2) / 2)


@pytest.mark.parametrize(("done", "weights"), [(0.0, (0.4, 0.7, 1)), (0.5, (0.1, 0.1, 1))])
def test_the_closest_masks_have_the_largest_contrast_weight(done, weights):
    means = RNG.normal(size=(4, 6))
    squares = np.square(means[:, None] - means).sum(axis=2)
    farthest_first = np.sort(squares, axis=1)[:, :0:-1]
    expected = (weights / (farthest_first + 1)).mean()
    assert contrast_loss(torch.from_numpy(means), done).item() == pytest.approx(expected)
    assert contrast_loss(torch.from_numpy(means[:1]), done).item() == 0


def test_the_coarse_codebook_splits_by_position_and_the_fine_one_by_feature():
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
def test_a_group_has_the_average_code_of_its_best_mask_in_each_view(
    monkeypatch, least, views, num_views, far, expected
):
    monkeypatch.setattr(groups, "MIN_SCORE", least)
    monkeypatch.setattr(groups, "MIN_VIEWS", views)
    # view 0: mask 0 contains both Gaussians of group 0 (IoU 1), mask 1 one of them; view 1: mask 2, IoU 2/3
    shares, means = np.float32([[1, 1, 0], [1, 0, 0], [1, 1, 1]]), np.zeros((3, 3), np.float32)
    if far is not None:
        means[far, 2] = 0.9  # the mean feature of the mask, 0 in the group
    contributions = types.SimpleNamespace(
        matrix={
            "S": sp.csr_matrix(shares),
            "A": sp.csr_matrix(means),
            "mass": sp.csr_matrix(np.ones((num_views, 3), np.float32)),
        }.get,
        view=np.array([0, 0, 1], np.int32),
    )
    inputs = types.SimpleNamespace(contributions=contributions, latents=np.float32([[1], [5], [2]]))
    features = np.float32([[0], [0], [1]])
    found = inspect.unwrap(groups.associated_codes)(inputs, np.array([0, 0, -1]), np.arange(3), features)
    assert found.tolist() == [[expected], [expected], [0.0]]


def test_neighbour_loss_is_the_divergence_per_class():
    logits = torch.tensor([[0.0, 0.0]])
    assert neighbour_loss(logits, logits[:, None], 2).item() == pytest.approx(0)
    others = torch.log(torch.tensor([[[0.25, 0.75]]]))
    expected = 0.5 * np.log(0.5 / 0.25) + 0.5 * np.log(0.5 / 0.75)
    assert neighbour_loss(logits, others, 2).item() == pytest.approx(expected / 2)


def test_hierarchical_loss_matches_a_plain_loop_over_pixels():
    labels = np.repeat(np.int32([[0, 2, 4], [0, 2, 5], [0, 3, -1], [1, -1, -1]]), 4, axis=0)
    patch, shared = patches(np.append(labels, np.int32([[0, -1, -1]]), axis=0))
    assert patch.tolist() == [*np.arange(4).repeat(4), -1]  # a patch of one pixel is left out
    assert shared.tolist() == [[3, 2, 1, 0], [2, 3, 1, 0], [1, 1, 2, 0], [0, 0, 0, 1]]
    patch = patch[:-1]
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


def test_clusters_of_smaller_distances_are_inside_those_of_larger_ones():
    # two pairs of directions: 20 degrees apart inside a pair, 90 between pairs
    angle = np.deg2rad([0, 20, 90, 110]).repeat(5)
    features = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    found = groups.clusters(features, (1.0, 0.2, 0.01), 0, "cosine")
    assert [len(np.unique(level)) for level in found.T][1:] == [2, 4]
    for coarse, fine in ((0, 1), (1, 2)):
        assert len(np.unique(found[:, [coarse, fine]], axis=0)) == len(np.unique(found[:, fine]))


def test_ultrametric_is_the_least_longest_edge_of_any_path_and_two_without_a_path():
    vectors = torch.from_numpy(RNG.normal(size=(13, 3)))
    edges = np.array([(a, b) for a in range(12) for b in range(a + 1, 12) if RNG.random() < 0.3]).T
    found = ultrametric(vectors, edges, np.zeros(edges.shape[1]), np.indices((13, 13)).reshape(2, -1))
    longest = np.where(np.eye(13), 0, np.inf)
    apart = np.linalg.norm(vectors[edges[0]] - vectors[edges[1]], axis=1)
    longest[edges[0], edges[1]] = longest[edges[1], edges[0]] = apart
    for way in range(13):
        longest = np.minimum(longest, np.maximum(longest[:, way, None], longest[way]))
    longest[np.isinf(longest)] = 2
    assert found.numpy() == pytest.approx(longest.ravel(), abs=1e-6)
    none = ultrametric(vectors, edges[:, :0], np.zeros(0), np.array([[0, 2], [2, 2]]))
    assert none.tolist() == [2, 0]


def test_border_penalties_choose_the_tree_but_do_not_change_lengths_or_gradients():
    # pixels 0 - 1 - 2, and a short way 0 - 2 over a border
    vectors = torch.tensor([[0.0], [1.0], [0.4]], dtype=torch.float64, requires_grad=True)
    edges, pairs = np.array([[0, 1, 0], [1, 2, 2]]), np.array([[0], [2]])
    inside = ultrametric(vectors, edges, np.array([0.0, 0.0, 10.0]), pairs)
    assert inside.item() == pytest.approx(1.0)  # over pixel 1, the longer edge 0 - 1
    assert ultrametric(vectors, edges, np.zeros(3), pairs).item() == pytest.approx(0.4)
    inside.sum().backward()
    assert vectors.grad.ravel().tolist() == pytest.approx([-1.0, 1.0, 0.0])


def test_the_third_pixel_of_a_triplet_is_outside_the_mask_but_inside_its_parent():
    # one row of pixels: whole 0 holds parts 1 and 2; pixel 5 is outside
    labels = np.full((6, 3), -1, np.int32)
    labels[:5, 0], labels[:2, 1], labels[2:4, 1] = 0, 1, 2
    found = triplets(labels, np.array([1, 2, 2]), np.array([-1, 0, 0], np.int32), np.random.default_rng(0))
    whole, first, second = found.reshape(3, 3, -1).swapaxes(0, 1)
    assert set(whole[0]) == {0, 1, 2, 3, 4} and set(whole[2]) == {5}
    assert set(first[1]) == {0, 1} and set(first[2]) == {2, 3, 4}
    assert set(second[0]) == {2, 3} and set(second[2]) == {0, 1, 4}


def test_components_split_where_features_jump_and_small_ones_join_the_nearest_large_one(monkeypatch):
    means = np.stack([np.arange(60.0), np.zeros(60), np.zeros(60)], axis=1).astype(np.float32)
    features = np.zeros((60, 2), np.float32)
    features[:30, 0], features[30:50, 1] = 1, 1
    features[50:] = 0.8, 0.6  # 1.41 from the first to the second run, 0.89 to the third, 0.63 between these
    found = components(features, means, (1.5, 0.95, 0.1))
    assert [len(np.unique(level)) for level in found.T] == [1, 2, 3]
    assert found[0, 2] == 0 and found[30, 2] == 1 and found[50, 2] == 2  # largest first
    monkeypatch.setattr(vch, "MAX_COMPONENTS", 2)
    assert (components(features, means, (1.5, 0.95, 0.1))[50:, 2] == 1).all()


def test_density_clusters_connect_dense_points_and_ignore_isolated_ones():
    line = np.float32([0, 0.1, 0.2, 0.3, 5, 5.1, 5.2, 9, 0.45])[:, None]  # the last is near one point only
    assert groups.density_clusters(line, 0.16, 3).tolist() == [-1, 0, 0, 0, -1, 1, -1, -1, -1]
    assert groups.density_clusters(line, 0.16, 1).tolist() == [0, 0, 0, 0, 1, 1, 1, 2, 0]
    assert groups.density_clusters(line[:0], 0.1, 3).tolist() == []


# ---- LEGaussians ----------------------------------------------------------------------------------------


def test_uncertainty_reduces_the_cross_entropy_and_is_penalised():
    logits, index = torch.tensor([[2.0, 0], [0, 1.0]]), torch.tensor([0, 0])
    each = cross_entropy(logits, index, reduction="none").tolist()
    found = legaussians.index_loss(logits, index, torch.tensor([0.0, 0.75])).item()
    assert found == pytest.approx((each[0] + 0.25 * each[1]) / 2 - np.log(0.25) / 2)


def test_certain_codes_are_smoothed_a_tenth_as_much_as_uncertain_ones():
    codes, predicted = torch.zeros(2, 8, requires_grad=True), torch.ones(2, 8, requires_grad=True)
    legaussians.smoothing_loss(codes, predicted, torch.tensor([0.0, 1.0])).backward()
    # (1 / 2 points) (1 / 8 numbers) 2 (0 - 1), times 0.1 and 1
    assert codes.grad[:, 0].tolist() == pytest.approx([-0.0125, -0.125])
    assert predicted.grad[:, 0].tolist() == pytest.approx([0.125, 0.125])


# ---- LaGa -----------------------------------------------------------------------------------------------


def test_masks_repeated_at_a_finer_level_are_ignored_unless_all_are():
    labels = np.full((20, 3), -1, np.int32)
    labels[:10, 0], labels[10:, 0] = 0, 1
    labels[:9, 1] = 2  # IoU 0.9 with mask 0
    whole, part, subpart = laga.masks_of_pixels(labels)
    assert whole.T.tolist() == [[False] * 10 + [True] * 10]
    assert part.sum() == 9 and subpart.shape == (20, 0)
    labels[10:, 1] = 3  # now both wholes are repeated
    assert laga.masks_of_pixels(labels)[0].shape == (20, 2)


def test_nested_loss_matches_a_plain_loop_over_pixels_and_masks():
    rendered = torch.from_numpy(RNG.normal(size=(12, 32)).astype(np.float32))
    masks = [np.zeros((12, count), bool) for count in (2, 2, 1)]
    masks[0][:6, 0] = masks[0][6:, 1] = masks[1][:4, 0] = masks[1][6:9, 1] = masks[2][:2, 0] = True
    draws = np.random.default_rng(5)
    found = laga.nested_loss(rendered, masks, np.random.default_rng(5)).item()

    def cosine(level, prefix, pixel, mask):
        own = rendered.numpy()[:, : laga.PREFIX[prefix]].astype(np.float64)
        prototype = own[masks[level][:, mask]].sum(axis=0)
        return own[pixel] @ prototype / np.linalg.norm(own[pixel]) / np.linalg.norm(prototype)

    slices = np.split(rendered.numpy(), [16, 24], axis=1)
    expected = (1 - np.mean([np.linalg.norm(part, axis=1).mean() for part in slices])) ** 2
    for level, shown in enumerate(masks):
        draw, near, far = draws.random(shown.shape, dtype=np.float32), [], []
        for pixel, mask in np.ndindex(*shown.shape):
            own = cosine(level, level, pixel, mask)
            if shown[pixel, mask]:
                near.append(own if level == 0 else min(own, cosine(level, level - 1, pixel, mask)))
            elif draw[pixel, mask] < shown[:, mask].sum() / (~shown[:, mask]).sum() or own > 0.5:
                far.append(max(0, own if level == 2 else max(own, cosine(level, level + 1, pixel, mask))))
        expected += np.mean(far) - np.mean(near)
    assert found == pytest.approx(expected, rel=1e-4)


def test_a_gaussian_joins_the_nearest_object_of_at_least_five_masks():
    prototypes = np.float32([[1, 0, 0]] * 5 + [[0, 1, 0]] * 6 + [[0, 0, 1]] * 4)
    features = np.float32([[0.6, 0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    group, of_mask = laga.objects(features, prototypes, 0.1, 5)
    assert of_mask.tolist() == [0] * 5 + [1] * 6 + [-1] * 4 and group.tolist() == [1, 0, 0]
    group, _ = laga.objects(features, prototypes[:4], 0.1, 5)
    assert group.tolist() == [-1, -1, -1]


def test_silhouette_matches_hand_computation():
    # groups {0, 1}, {4}, {6, 8}; alone: 0
    place, group = np.array([0.0, 1, 4, 6, 8]), np.array([0, 0, 1, 2, 2])
    each = [(4 - 1) / 4, (3 - 1) / 3, 0, (2 - 2) / 2, (4 - 2) / 4]
    found = laga.silhouette(np.abs(place[:, None] - place[None]), group)
    assert found == pytest.approx(np.mean(each))


def test_descriptors_of_an_object_are_weighted_by_their_cosine_with_the_average():
    angle = np.deg2rad([-1, -0.6, -0.2, 0.2, 0.6, 1, 59, 60, 61])
    vectors = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
    weight = laga.descriptor_weights(vectors, 0)
    average = vectors.mean(axis=0) / np.linalg.norm(vectors.mean(axis=0))
    looks = [vectors[:6].mean(axis=0), vectors[6:].mean(axis=0)]
    expected = [
        look @ average / np.linalg.norm(look) / size for look, size in zip(looks, (6, 3), strict=True)
    ]
    assert weight == pytest.approx(np.repeat(expected, (6, 3)), rel=1e-5)
    assert laga.descriptor_weights(vectors[:1], 0) == pytest.approx([1.0])


def test_the_code_of_an_object_has_the_direction_of_the_weighted_sum_of_its_vectors():
    vectors = np.abs(RNG.normal(size=(6, 8))).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    code = LinearCode.fit(vectors, 6)
    latents = code.encode_array(vectors)
    found = laga.object_latents(np.array([0, 0, 0, 1, 1, -1]), latents, code, 0)
    weight = laga.descriptor_weights(vectors[:3], 0)
    expected = weight @ vectors[:3]
    assert code.decode_array(found)[0] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-4)
    assert found.shape == (2, 6)


# ---- SAGA -----------------------------------------------------------------------------------------------


def test_pixels_share_masks_up_to_a_scale_and_the_smallest_one_above_it():
    # whole 0 (scale 4) holds parts 1 and 2 (scale 2); pixel 3 is in the whole alone, pixel 4 in another
    labels = np.int32([[0, 1, -1], [0, 1, -1], [0, 2, -1], [0, -1, -1], [5, -1, -1]])
    scales = np.where(labels >= 0, np.where(labels % 5 == 0, 4.0, 2.0), 0)
    large = saga.grouped_at(labels, scales, 5.0)
    assert large[:4, :4].all() and not large[4, :4].any()
    between = saga.grouped_at(labels, scales, 3.0)
    assert (between == large).all()  # parts stay masks of their own, and the whole is the smallest above
    small = saga.grouped_at(labels, scales, 1.0)
    assert small[0].tolist() == [True, True, False, False, False]
    assert small[3].tolist() == [False, False, False, True, False]


def test_scales_are_drawn_between_neighbouring_masks_and_beyond_both_ends():
    drawn = saga.drawn_scales(np.array([4.0, 1.0, 2.0]), np.random.default_rng(0))
    assert len(drawn) == 4 and 0 <= drawn[0] <= 1 and 4 <= drawn[-1] <= 8
    assert sorted(np.searchsorted([1, 2, 4], drawn[1:-1])) == [1, 2]
    assert len(saga.drawn_scales(np.arange(1.0, 30), np.random.default_rng(0))) == saga.SCALES + 2


def test_pairs_of_pixels_in_small_masks_have_ten_times_the_weight():
    assert saga.pair_weights(np.array([1.0, 10.0])) == pytest.approx(
        np.float32([[10, 1 + 9 * 9 / 99], [1 + 9 * 9 / 99, 1]])
    )


def test_affinity_loss_matches_a_plain_loop_over_pairs_and_scales():
    rendered = torch.from_numpy(RNG.normal(size=(6, 32)).astype(np.float32))
    gates = torch.from_numpy(RNG.random((3, 32)).astype(np.float32))
    same = RNG.random((3, 6, 6)) < 0.5
    same |= same.transpose(0, 2, 1)
    same[:, 0, 1], same[:, 0, 2] = True, False
    weight = saga.pair_weights(RNG.random(6) + 0.1)
    found = saga.affinity_loss(rendered, gates, same, weight, np.random.default_rng(4)).item()
    draw = np.random.default_rng(4).random((6, 6), dtype=np.float32)
    gated = unit(rendered[None] * gates[:, None]).numpy()
    always, never = same.all(axis=0), ~same.any(axis=0)
    mixed = ~(always | never)
    attract, repel = [], []
    for p, q in zip(*np.triu_indices(6, 1), strict=True):
        cosine = [gated[s, p] @ gated[s, q] for s in range(3)]
        pull = mixed[p, q] or (always[p, q] and draw[p, q] < mixed.sum() / 2 / always.sum())
        push = mixed[p, q] or (never[p, q] and draw[p, q] < mixed.sum() / 2 / max(never.sum(), 1))
        if pull or any(same[s, p, q] and cosine[s] < 0.75 for s in range(3)):
            attract += [weight[p, q] * same[s, p, q] * cosine[s] for s in range(3)]
        if push or any(not same[s, p, q] and cosine[s] > 0.5 for s in range(3)):
            repel += [weight[p, q] * (not same[s, p, q]) * max(cosine[s], 0) for s in range(3)]
    length = rendered.norm(dim=1).mean().item()
    assert found == pytest.approx((1 - length) ** 2 - np.mean(attract) + np.mean(repel), rel=1e-4)


def test_the_scale_of_a_mask_is_twice_the_spread_of_its_gaussians():
    class World:
        matrix = {"A": sp.csr_matrix(np.float32([[0.5, 0.5, 0], [0, 0, 1]]))}.get
        means = staticmethod(lambda: np.float32([[100, 0, 0], [106, 8, 0], [1, 1, 1]]))

    found = inspect.unwrap(saga.mask_scales)(World)
    assert found == pytest.approx([10, 0], abs=1e-5)  # 10 apart: a deviation of 5


# ---- k-means ----


@pytest.mark.parametrize(
    ("rows", "count", "expected"),
    [
        ([[0, 0], [9, 0], [0, 0.2], [9, 0.2]], 2, [[0, 0.1], [9, 0.1], [0, 0.1], [9, 0.1]]),
        ([[1, 2], [3, 4], [1, 2]], 4, [[1, 2], [3, 4], [1, 2]]),  # more centroids than distinct rows
    ],
)
def test_centroids_are_the_means_of_groups_and_the_first_is_repeated(rows, count, expected):
    centroids, nearest = groups.kmeans(np.float32(rows), count, seed=1)
    assert centroids[nearest] == pytest.approx(np.float32(expected))
    assert centroids.dtype == np.float32 and nearest.dtype == np.int64
    assert (centroids[2:] == centroids[0]).all() and len(np.unique(centroids, axis=0)) == 2


@pytest.mark.parametrize("seed", range(5))
def test_distant_starts_find_separated_groups_in_one_round(seed):
    rng = np.random.default_rng(seed)
    rows = np.repeat(np.float32([[0, 0], [50, 0], [0, 50]]), 10, axis=0)
    _, nearest = groups.kmeans(rows + 0.01 * rng.random(rows.shape).astype(np.float32), 3, seed, rounds=1)
    found = nearest.reshape(3, 10)
    assert (found == found[:, :1]).all() and len(np.unique(found)) == 3
