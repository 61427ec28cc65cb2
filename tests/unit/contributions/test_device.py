"""Contributions on a simulated card, with gsplat's reference functions in torch."""

import time
from collections.abc import Callable
from threading import Semaphore

import gsplat
import numpy as np
import pytest
import scipy.sparse as sp
import torch

from hilsplat.base.errors import DeviceError
from hilsplat.base.lineage import sha256_of_path
from hilsplat.contributions import device as card
from hilsplat.contributions import view_matrices
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.stage import run_contributions
from hilsplat.scene.cameras import Camera
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from hilsplat.splat.rasterise import cuda
from hilsplat.splat.rasterise import device as choice
from hilsplat.splat.rasterise.api import pixel_weights
from tests.unit.card_on_cpu import KERNELS, replace_kernels
from tests.unit.contributions.test_contributions import random_view
from tests.unit.segment.handmade import pack
from tests.unit.simulated_card import kernel, simulated_card
from tests.unit.splat.rasterise_scenes import camera, random_gaussians
from tests.unit.two_boxes_world import two_boxes_weights


@pytest.fixture(autouse=True)
def _card(monkeypatch, request):
    if request.node.get_closest_marker("gpu"):
        if problem := choice.cuda_problem():
            pytest.skip(f"no CUDA device: {problem}")
        yield
        return
    replace_kernels(monkeypatch)
    for name in KERNELS:
        monkeypatch.setattr(gsplat, name, kernel(getattr(gsplat, name)))
    monkeypatch.setattr(cuda, "DEVICE", "cuda")
    with simulated_card(monkeypatch):
        yield


def entries(weights: sp.csr_matrix) -> cuda.Entries:
    """The weights on the device."""
    arrays = weights.indptr.astype(np.int64), weights.indices.astype(np.int64), weights.data
    return cuda.Entries(*(torch.tensor(array, device=cuda.DEVICE) for array in arrays), weights.shape[1])


@pytest.mark.parametrize("most", [1, 60, 2**24])
@pytest.mark.parametrize(
    ("seed", "rows", "covered"),
    [*((seed, range(8), 1.0) for seed in range(3)), (0, [], 0.0), (0, [], 1.0), (0, [2], 0.0), (0, [2], 1.0)],
)
def test_matrices_of_a_view_equal_those_of_the_cpu(monkeypatch, seed, rows, covered, most):
    monkeypatch.setattr(card, "MAX_LISTED", most)
    raw, masks = random_view(seed)
    raw, masks = (raw * covered).tocsr(), masks.take(np.array(rows, np.int64))
    on_card = card.normalised_entries(entries(raw))
    weights = normalised_weights(raw)
    np.testing.assert_array_equal(on_card.on_host().toarray(), weights.toarray())
    expected = view_matrices.view_contributions("v", weights, masks)
    found = card.view_contributions("v", on_card, masks)
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype, name
        np.testing.assert_allclose(found[name], values, rtol=1e-6, err_msg=name)


def random_masks(size_hw: tuple[int, int]) -> HierarchicalMasks:
    """Overlapping rectangles at three levels."""
    rng, dense = np.random.default_rng(0), np.zeros((12, *size_hw), bool)
    for mask in dense:
        top, left = rng.integers(0, size_hw[0] - 12), rng.integers(0, size_hw[1] - 12)
        mask[top : top + rng.integers(4, 24), left : left + rng.integers(4, 24)] = True
    return pack(dense, np.repeat([1, 2, 3], 4))


@pytest.mark.parametrize("where", ["gsplat's reference", pytest.param("a card", marks=pytest.mark.gpu)])
def test_drawn_contributions_equal_those_of_the_cpu(where):
    gaussians, view = random_gaussians(300), camera()
    masks, tolerance = random_masks(view.size_hw), {"rtol": 1e-4, "atol": 1e-6}
    on_card = card.drawn_weights(cuda.on_device(gaussians), view, min_weight=1 / 255)
    weights = normalised_weights(pixel_weights(gaussians, view, min_weight=1 / 255))
    # a pixel whose alpha is 0.5, or a weight of 1/255, up to rounding may be on either side
    assert abs(on_card.on_host() - weights).max(axis=0).toarray().max() < 1e-4
    found = card.view_contributions("v", on_card, masks)
    expected = view_matrices.view_contributions("v", weights, masks)
    for name in ("A", "A_half", "S", "mass"):
        parts = [
            sp.csr_matrix((each[f"{name}_data"], each[f"{name}_indices"], each[f"{name}_indptr"])).toarray()
            for each in (found, expected)
        ]
        np.testing.assert_allclose(*parts, **tolerance, err_msg=name)


@pytest.fixture
def draw_two_boxes(two_boxes, monkeypatch) -> Callable[[], list[str]]:
    """Let a card draw the world of two boxes; return the names of the drawn views."""
    drawn = list[str]()

    def weights(g: dict[str, torch.Tensor], camera: Camera, *, min_weight: float) -> cuda.Entries:
        drawn.append(camera.name)
        raw = two_boxes_weights(two_boxes.views.index(camera.name))
        return card.normalised_entries(entries(raw))

    monkeypatch.setattr(card, "drawn_weights", weights)
    return drawn


def test_the_stage_uses_a_card_only_on_request(two_boxes, draw_two_boxes):
    inputs = two_boxes.scene, two_boxes.ply, two_boxes.masks
    digests = set()
    for device, number in (("cuda", 4), ("auto", 4), ("cpu", 4)):
        out = two_boxes.folder / device
        settings = ContributionsSettings(device=device)
        run_contributions(*inputs, out, two_boxes.folder / "cache", settings, 1)
        assert len(draw_two_boxes) == number
        digests.add(sha256_of_path(out))
    assert len(digests) == 1  # W is the same here, and so are the sums of few weights
    assert ContributionsSettings().rasteriser == "cpu"  # and so the provenance record says


def test_a_card_prepares_one_view_at_a_time(two_boxes, draw_two_boxes, monkeypatch):
    compute, most, together = card.view_contributions, [0], Semaphore(1)

    def watched(*given: object) -> dict[str, np.ndarray]:
        is_alone = together.acquire(blocking=False)
        most[0] += not is_alone
        time.sleep(0.05)  # two threads would both be here
        if is_alone:
            together.release()
        return compute(*given)

    monkeypatch.setattr(card, "view_contributions", watched)
    inputs = two_boxes.scene, two_boxes.ply, two_boxes.masks, two_boxes.folder / "out", two_boxes.folder / "c"
    run_contributions(*inputs, ContributionsSettings(device="cuda"), 4)
    assert len(draw_two_boxes) == 4 and most == [0]


def test_memory_that_runs_out_is_an_error_with_a_fix(two_boxes, monkeypatch):
    def fail(*arguments: object, **options: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. 1.50 GiB is free.\nSee")

    monkeypatch.setattr(card, "drawn_weights", fail)
    inputs = two_boxes.scene, two_boxes.ply, two_boxes.masks, two_boxes.folder / "out", two_boxes.folder / "c"
    with pytest.raises(DeviceError, match=r"(?s)needs more memory.*Tried to allocate.*contributions.device"):
        run_contributions(*inputs, ContributionsSettings(device="cuda"), 1)
