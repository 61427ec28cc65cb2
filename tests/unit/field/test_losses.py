"""L_lang, L_h, L_ins and L_part against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hilsplat.field.losses.distances import (
    SOFTENING,
    common_ancestor_depth,
    similarity_without_parent,
    soft_distances,
)
from hilsplat.field.losses.instance import (
    instance_loss_literal,
    instance_loss_tree,
)
from hilsplat.field.losses.latent_regression import latent_regression_loss
from hilsplat.field.losses.part import part_loss_disentangle, part_loss_literal
from tests.unit.field.clustering import clustering_loss


def doubles(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_regression_averages_squared_distances_over_labelled_pixels():
    features = torch.tensor([[[1.0], [3.0], [10.0]]])
    labels = torch.tensor([[0, 1, -1]])
    latents = torch.tensor([[2.0], [0.0]])
    # (1 - 2)^2 and (3 - 0)^2 over two labelled pixels; the third has no mask
    assert latent_regression_loss(features, labels, latents).item() == pytest.approx(5.0)


def test_regression_of_a_view_without_masks_is_zero():
    labels = torch.full((2, 2), -1)
    assert latent_regression_loss(torch.ones(2, 2, 3), labels, torch.zeros(0, 3)).item() == 0


def test_clustering_loss_matches_hand_computation():
    features = torch.tensor([[[1.0], [3.0], [10.0], [7.0]]])
    labels = torch.tensor([[0, 0, -1, 1]])
    # mask 0 has mean 2 and squares 1 + 1; mask 1 is one pixel; three labelled pixels
    assert clustering_loss(features, labels).item() == pytest.approx(2 / 3)


def test_regression_is_clustering_plus_distance_of_the_mean():
    features = doubles(4, 5, 3)
    labels = torch.zeros(4, 5, dtype=torch.long)
    latent = doubles(1, 3, seed=1)
    mean = features.reshape(-1, 3).mean(0)
    expected = clustering_loss(features, labels) + (mean - latent[0]).square().sum()
    assert latent_regression_loss(features, labels, latent).item() == pytest.approx(expected.item())


def test_clustering_ignores_a_shift_of_everything():
    features, labels = doubles(3, 4, 2), torch.tensor([[0, 0, 1, 1]] * 3)
    shifted = clustering_loss(features + 5, labels)
    assert shifted.item() == pytest.approx(clustering_loss(features, labels).item())


def test_depth_of_common_ancestors():
    # 0 holds 1 and 2, 1 holds 3; 4 is unrelated
    depth = common_ancestor_depth(np.array([-1, 0, 0, 1, -1], dtype=np.int32))
    assert depth.tolist() == [
        [1, 1, 1, 1, 0],
        [1, 2, 1, 2, 0],
        [1, 1, 2, 1, 0],
        [1, 2, 1, 3, 0],
        [0, 0, 0, 0, 1],
    ]


def test_distances_are_softened_at_zero():
    assert soft_distances(torch.zeros(2, 3)).flatten().tolist() == pytest.approx([SOFTENING] * 4)


@pytest.mark.parametrize(("levels", "distance"), [((1, 1), 1.0), ((1, 2), 0.1), ((1, 3), 0.01)])
def test_literal_instance_loss_is_least_at_omega_to_the_minus_level_difference(levels, distance):
    level = torch.tensor(levels)

    def loss(d: float) -> float:
        means = torch.tensor([[0.0], [math.sqrt(d**2 - SOFTENING**2)]], dtype=torch.float64)
        return instance_loss_literal(means, level, 10.0).item()

    assert loss(distance) == pytest.approx(0, abs=1e-9)
    assert loss(distance * 2) == pytest.approx(math.log(2) ** 2, rel=1e-6)
    assert loss(distance / 2) == pytest.approx(math.log(2) ** 2, rel=1e-6)


def test_tree_instance_loss_puts_relatives_close_whatever_their_level():
    depth = torch.tensor([[1, 0], [0, 1]])  # unrelated: distance 1
    means = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    assert instance_loss_tree(means, depth, 10.0).item() == pytest.approx(0, abs=1e-9)
    related = torch.tensor([[1, 1], [1, 2]])  # a part and its whole: distance 0.1
    assert instance_loss_tree(means, related, 10.0).item() == pytest.approx(math.log(10) ** 2, rel=1e-5)


@given(st.permutations(range(5)))
def test_instance_losses_ignore_the_order_of_masks(order):
    means = doubles(5, 3)
    depth = torch.tensor(common_ancestor_depth(np.array([-1, 0, 0, 1, -1], dtype=np.int32)))
    level = torch.tensor([1, 2, 2, 3, 1])
    order = torch.tensor(order)
    same = depth[order][:, order]
    for before, after in (
        (instance_loss_tree(means, depth, 10.0), instance_loss_tree(means[order], same, 10.0)),
        (instance_loss_literal(means, level, 10.0), instance_loss_literal(means[order], level[order], 10.0)),
    ):
        assert after.item() == pytest.approx(before.item())


def test_similarity_subtracts_the_anchors_parent():
    anchors, parent = torch.tensor([[2.0, 1.0]]), torch.tensor([[1.0, 1.0]])
    others = torch.tensor([[1.0, 3.0], [0.0, 1.0], [5.0, 1.0]])
    # anchor - parent = (1, 0); others - parent = (0, 2), (-1, 0), (4, 0)
    assert similarity_without_parent(anchors, others, parent)[0].tolist() == pytest.approx([0, -1, 1])


def test_literal_part_loss_matches_hand_computation():
    # parents at the origin: cosines of the masks themselves
    means = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)
    parent = torch.tensor([7, 7, 8])
    # anchors 0 and 1 (mask 2 has no sibling): positive cosine 0; negative cosines -1 and 0.
    # -log(exp(0) / exp(-1 / 0.5)) = -2, and -log(exp(0) / exp(0)) = 0; mean -1
    loss = part_loss_literal(means, parent, torch.zeros_like(means), tau=0.5)
    assert loss.item() == pytest.approx(-1.0)


def test_literal_part_loss_leaves_orphans_out():
    means = doubles(4, 3)
    parents = torch.zeros(4, 3, dtype=torch.float64)
    with_orphan = part_loss_literal(means, torch.tensor([7, 7, 8, -1]), parents, 0.1)
    without = part_loss_literal(means[:3], torch.tensor([7, 7, 8]), parents[:3], 0.1)
    assert with_orphan.item() == pytest.approx(without.item())
    assert part_loss_literal(means, torch.tensor([-1] * 4), parents, 0.1).item() == 0


def test_disentangling_part_loss_matches_hand_computation():
    half = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
    parents = torch.zeros(2, 2, dtype=torch.float64)
    # each half meets its twin (cosine 1) and one other mask (cosine 0): log(1 + exp(-1 / 0.5))
    loss = part_loss_disentangle(half, half.clone(), torch.tensor([1, 1]), parents, tau=0.5)
    assert loss.item() == pytest.approx(math.log(1 + math.exp(-2)))


def test_the_parent_is_no_target_of_the_part_loss():
    parent_means = doubles(3, 3, seed=2).requires_grad_()
    means = doubles(3, 3).requires_grad_()
    loss = part_loss_literal(means, torch.tensor([0, 0, 1]), parent_means, 0.1)
    (gradient,) = torch.autograd.grad(loss, parent_means, allow_unused=True)
    assert gradient is None


def test_gradients_agree_with_finite_differences():
    means, parents = doubles(5, 3).requires_grad_(), doubles(5, 3, seed=3)
    depth = torch.tensor(common_ancestor_depth(np.array([-1, 0, 0, 1, -1], dtype=np.int32)))
    level, parent = torch.tensor([1, 2, 2, 3, 1]), torch.tensor([0, 0, 1, 1, -1])
    has = torch.tensor([1, 1, 0, 1, 0])
    other = doubles(5, 3, seed=4)
    labels = torch.tensor([[0, 0, 1, -1, 1]])
    for loss in (
        lambda x: instance_loss_literal(x, level, 10.0),
        lambda x: instance_loss_tree(x, depth, 10.0),
        lambda x: part_loss_literal(x, parent, parents, 0.5),
        lambda x: part_loss_disentangle(x, other, has, parents, 0.5),
        lambda x: clustering_loss(x[None], labels),
        lambda x: latent_regression_loss(x[None], labels, other),
    ):
        assert torch.autograd.gradcheck(loss, (means,))
