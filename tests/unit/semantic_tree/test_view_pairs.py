"""The pairs of views whose masks are compared."""

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.semantic_tree import view_pairs as module
from hilsplat.semantic_tree.linkage import mask_evidence
from hilsplat.semantic_tree.view_pairs import view_pairs

VIEWS = 40


@pytest.fixture
def bounded(monkeypatch):
    """Bounds that act on a few views."""
    for name, value in {"MAX_ALL": 10, "NEAREST": 4, "SPREAD": 3}.items():
        monkeypatch.setattr(module, name, value)


def ring(views: int = VIEWS, places: int = 1) -> sp.csr_matrix:
    """Views in a ring at each place; each shows half of the ring's Gaussians, ten per step."""
    gaussian = np.arange(10 * views)
    ahead = (gaussian - 10 * np.arange(views)[:, None]) % (10 * views)
    one = sp.csr_matrix((ahead < 5 * views).astype(np.float32))
    return sp.block_diag([one] * places, format="csr")


def partners_of(visible: sp.csr_matrix) -> list[list[int]]:
    pairs = view_pairs(visible)
    rows = np.split(pairs.partners, pairs.indptr[1:-1])
    for view, partners in enumerate(rows):
        for place, partner in enumerate(partners):
            mirror = pairs.mirror[pairs.indptr[view] + place]
            assert rows[partner][mirror] == view
    return [row.tolist() for row in rows]


def test_a_small_scene_compares_all_views():
    assert partners_of(ring()) == [list(range(VIEWS))] * VIEWS


def test_a_large_scene_compares_the_nearest_views_and_some_others(bounded):
    for view, partners in enumerate(partners_of(ring())):
        assert {(view + step) % VIEWS for step in (-2, -1, 0, 1, 2)} <= set(partners)
        assert partners == sorted(set(partners))
        assert len(partners) < VIEWS / 2
    apart = [min(abs(a - b), VIEWS - abs(a - b)) for a, row in enumerate(partners_of(ring())) for b in row]
    assert max(apart) > VIEWS / 4


def test_views_of_different_places_are_not_partners(bounded):
    for view, partners in enumerate(partners_of(ring(20, places=2))):
        assert all(partner // 20 == view // 20 for partner in partners)


def test_counting_a_sample_finds_the_same_nearest_views(bounded, monkeypatch):
    monkeypatch.setattr(module, "MAX_SHARED", 20_000)  # every ninth Gaussian
    for view, partners in enumerate(partners_of(ring())):
        assert {(view - 1) % VIEWS, (view + 1) % VIEWS} <= set(partners)


def test_pairs_of_masks_from_partners_have_the_same_evidence(bounded, monkeypatch):
    rng = np.random.default_rng(0)
    visible, view = ring(), np.repeat(np.arange(VIEWS, dtype=np.int32), 3)
    shares = rng.random((len(view), visible.shape[1])) * (rng.random((len(view), visible.shape[1])) < 0.3)
    shares = sp.csr_matrix(shares * (visible.toarray()[view] > 0))

    def stored() -> dict[tuple[int, int], tuple[float, float]]:
        pairs = view_pairs(visible)
        found = mask_evidence(shares, np.ones(visible.shape[1]), visible, view, pairs, 0.2)
        (block,) = found.pairs
        masks = zip(block.firsts.tolist(), block.seconds.tolist(), strict=True)
        return dict(zip(masks, map(tuple, block.sums), strict=True))

    few = stored()
    monkeypatch.setattr(module, "MAX_ALL", VIEWS)
    every = stored()
    assert len(few) < len(every) / 2
    assert few == {pair: every[pair] for pair in few}


def test_a_view_without_visible_gaussians_is_its_own_partner(bounded):
    visible = sp.vstack([ring(), sp.csr_matrix((1, 10 * VIEWS), dtype=np.float32)], format="csr")
    assert partners_of(visible)[-1] == [VIEWS]
