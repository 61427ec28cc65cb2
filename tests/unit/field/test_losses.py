"""L_ins and L_part against numbers worked out by hand and autograd."""

import math

import numpy as np
import pytest
import torch

from hilsplat.field import losses
from tests.unit.field import torch_losses


def doubles(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_depth_of_common_ancestors():
    # 0 contains 1 and 2, 1 contains 3; 4 is unrelated
    depth = losses.common_ancestor_depth(np.array([-1, 0, 0, 1, -1], dtype=np.int32))
    assert depth.tolist() == [
        [1, 1, 1, 1, 0],
        [1, 2, 1, 2, 0],
        [1, 1, 2, 1, 0],
        [1, 2, 1, 3, 0],
        [0, 0, 0, 0, 1],
    ]


@pytest.mark.parametrize(("levels", "distance"), [((1, 1), 1.0), ((1, 2), 0.1), ((1, 3), 0.01)])
def test_literal_instance_loss_is_least_at_omega_to_the_minus_level_difference(levels, distance):
    level = np.array(levels)

    def loss(d: float) -> float:
        means = np.array([[0.0], [math.sqrt(d**2 - losses.SOFTENING**2)]])
        return losses.instance_loss_literal(means, level, 10.0)[0]

    assert loss(distance) == pytest.approx(0, abs=1e-9)
    assert loss(distance * 2) == pytest.approx(math.log(2) ** 2, rel=1e-6)
    assert loss(distance / 2) == pytest.approx(math.log(2) ** 2, rel=1e-6)


def test_the_tree_instance_loss_depends_on_relation_not_on_level():
    depth = np.array([[1, 0], [0, 1]])  # unrelated: distance 1
    means = np.array([[0.0], [1.0]])
    assert losses.instance_loss_tree(means, depth, 10.0)[0] == pytest.approx(0, abs=1e-9)
    related = np.array([[1, 1], [1, 2]])  # a part and its whole: distance 0.1
    assert losses.instance_loss_tree(means, related, 10.0)[0] == pytest.approx(math.log(10) ** 2, rel=1e-5)


def test_similarity_subtracts_the_anchors_parent():
    anchors, parent = np.array([[2.0, 1.0]]), np.array([[1.0, 1.0]])
    others = np.array([[1.0, 3.0], [0.0, 1.0], [5.0, 1.0]])
    # anchor - parent = (1, 0); others - parent = (0, 2), (-1, 0), (4, 0)
    assert losses.similarity_without_parent(anchors, others, parent)[0][0].tolist() == pytest.approx(
        [0, -1, 1]
    )


def test_literal_part_loss_matches_hand_computation():
    # parents at the origin: cosines of the masks themselves
    means = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    parent = np.array([7, 7, 8])
    # anchors 0 and 1 (mask 2 has no sibling): positive cosine 0; negative cosines -1 and 0.
    # -log(exp(0) / exp(-1 / 0.5)) = -2, and -log(exp(0) / exp(0)) = 0; mean -1
    loss, _ = losses.part_loss_literal(means, parent, np.zeros_like(means), tau=0.5)
    assert loss == pytest.approx(-1.0)


def test_disentangling_part_loss_matches_hand_computation():
    half = np.array([[1.0, 0.0], [0.0, 1.0]])
    parents = np.zeros((2, 2))
    # each half meets its twin (cosine 1) and one other mask (cosine 0): log(1 + exp(-1 / 0.5))
    loss, _, _ = losses.part_loss_disentangle(half, half.copy(), np.array([True, True]), parents, tau=0.5)
    assert loss == pytest.approx(math.log(1 + math.exp(-2)))


LEVEL = np.array([1, 2, 2, 3, 1])
DEPTH = losses.common_ancestor_depth(np.array([-1, 0, 0, 1, -1], dtype=np.int32))
PARENT, HAS = np.array([0, 0, 1, 1, -1]), np.array([True, True, False, True, False])
ANCHORS_ALONE = np.array([0, 1, 2, 3, -1])  # no mask has a sibling


@pytest.mark.parametrize(
    "name, own",
    [
        ("instance_loss_literal", (LEVEL, 10.0)),
        ("instance_loss_tree", (DEPTH, 10.0)),
        ("part_loss_literal", (PARENT, doubles(5, 3, seed=3).numpy(), 0.1)),
        ("part_loss_literal", (ANCHORS_ALONE, doubles(5, 3, seed=3).numpy(), 0.1)),
        ("part_loss_disentangle", (doubles(5, 3, seed=4).numpy(), HAS, doubles(5, 3, seed=3).numpy(), 0.1)),
    ],
)
@pytest.mark.parametrize("spread", [1.0, 1e-4])  # far, and nearer than the softening
def test_losses_and_gradients_are_those_of_autograd(name, own, spread):
    means = spread * doubles(5, 3).numpy()
    means[3] = means[0]  # distance zero
    loss, *gradients = getattr(losses, name)(means, *own)
    tensors = [torch.tensor(each) if isinstance(each, np.ndarray) else each for each in (means, *own)]
    moved = [each.requires_grad_() for each in tensors if torch.is_tensor(each) and each.is_floating_point()]
    expected = getattr(torch_losses, name)(*tensors)
    assert loss == pytest.approx(expected.item(), rel=1e-9)
    by_autograd = torch.autograd.grad(expected, moved, materialize_grads=True)
    for gradient, reference in zip(gradients, by_autograd, strict=False):
        assert gradient == pytest.approx(reference.numpy(), rel=1e-6, abs=1e-6 / spread)
