"""LEGaussians, LaGa and SAGA: losses worked by hand or by plain loops, and groups known by construction."""

import inspect

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from torch.nn.functional import cross_entropy

from hilsplat.field.linear_code import LinearCode
from hilsplat.methods import laga, legaussians, saga
from hilsplat.methods.common.groups import density_clusters
from hilsplat.methods.common.training import of_seen, product, unit

RNG = np.random.default_rng(0)


def test_only_seen_gaussians_are_rendered_and_the_result_is_the_same():
    matrix = sp.csr_matrix(np.float32([[0, 0.5, 0, 0.5], [0, 0, 0, 1]]))
    features = torch.from_numpy(RNG.random((4, 3)).astype(np.float32))
    small, seen = of_seen(matrix)
    assert seen.tolist() == [1, 3]
    assert torch.equal(product(small, features[seen]), product(matrix, features))


def test_density_clusters_join_dense_points_and_leave_lonely_ones():
    line = np.float32([0, 0.1, 0.2, 0.3, 5, 5.1, 5.2, 9, 0.45])[:, None]  # the last is near one point only
    assert density_clusters(line, 0.16, 3).tolist() == [-1, 0, 0, 0, -1, 1, -1, -1, -1]
    assert density_clusters(line, 0.16, 1).tolist() == [0, 0, 0, 0, 1, 1, 1, 2, 0]
    assert density_clusters(line[:0], 0.1, 3).tolist() == []


# ---- LEGaussians ----------------------------------------------------------------------------------------


def test_uncertainty_discounts_the_cross_entropy_and_has_a_price():
    logits, index = torch.tensor([[2.0, 0], [0, 1.0]]), torch.tensor([0, 0])
    each = cross_entropy(logits, index, reduction="none").tolist()
    found = legaussians.index_loss(logits, index, torch.tensor([0.0, 0.75])).item()
    assert found == pytest.approx((each[0] + 0.25 * each[1]) / 2 - np.log(0.25) / 2)


def test_uncertain_codes_follow_the_prediction_and_certain_ones_a_tenth():
    codes, predicted = torch.zeros(2, 8, requires_grad=True), torch.ones(2, 8, requires_grad=True)
    legaussians.smoothing_loss(codes, predicted, torch.tensor([0.0, 1.0])).backward()
    # (1 / 2 points) (1 / 8 numbers) 2 (0 - 1), times 0.1 and 1
    assert codes.grad[:, 0].tolist() == pytest.approx([-0.0125, -0.125])
    assert predicted.grad[:, 0].tolist() == pytest.approx([0.125, 0.125])


# ---- LaGa -----------------------------------------------------------------------------------------------


def test_masks_that_a_finer_level_repeats_are_left_out_unless_none_is_left():
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


def test_a_gaussian_belongs_to_the_nearest_object_and_an_object_has_five_masks():
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


def test_two_looks_of_an_object_are_two_descriptors_that_weigh_by_their_agreement_with_the_average():
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


def test_the_code_of_an_object_points_along_the_weighted_sum_of_its_vectors():
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
    large = saga.together(labels, scales, 5.0)
    assert large[:4, :4].all() and not large[4, :4].any()
    between = saga.together(labels, scales, 3.0)
    assert (between == large).all()  # parts stay masks of their own, and the whole is the smallest above
    small = saga.together(labels, scales, 1.0)
    assert small[0].tolist() == [True, True, False, False, False]
    assert small[3].tolist() == [False, False, False, True, False]


def test_scales_lie_between_those_of_neighbouring_masks_and_beyond_both_ends():
    drawn = saga.drawn_scales(np.array([4.0, 1.0, 2.0]), np.random.default_rng(0))
    assert len(drawn) == 4 and 0 <= drawn[0] <= 1 and 4 <= drawn[-1] <= 8
    assert sorted(np.searchsorted([1, 2, 4], drawn[1:-1])) == [1, 2]
    assert len(saga.drawn_scales(np.arange(1.0, 30), np.random.default_rng(0))) == saga.SCALES + 2


def test_pairs_of_pixels_in_small_masks_weigh_ten_times_those_in_large_ones():
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

    assert inspect.unwrap(saga.mask_scales)(World) == pytest.approx(
        [10, 0], abs=1e-5
    )  # 10 apart: a deviation of 5


def test_the_average_over_neighbours_keeps_what_is_the_same_everywhere():
    mean = saga.neighbour_mean(RNG.random((40, 3)).astype(np.float32))
    assert np.diff(mean.indptr).tolist() == [16] * 40 and mean.sum(axis=1) == pytest.approx(1)
    assert (mean.diagonal() > 0).all()
