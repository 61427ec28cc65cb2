"""Relevancy by hand, the linear code's relevancy against decoding every latent, and the code's algebra."""

import numpy as np
import pytest

from hilsplat.field.code import LinearCode, unit_rows
from hilsplat.query.relevancy import LatentRelevancy, relevancy


def test_nearest_canonical_phrase_decides():
    # axes are chosen so that the cosines are 0.30 with the text and 0.25, 0.28, 0.20, 0.22
    embedding = np.array([[0.30, 0.25, 0.28, 0.20, 0.22], [0.3, 0.1, 0.3, 0.1, 0.1]])
    score = relevancy(embedding, np.eye(5)[:1], np.eye(5)[1:])
    assert score == pytest.approx(np.array([[0.549834, 0.5]]), abs=1e-6)


@pytest.fixture(scope="module")
def vectors():
    """Sixty vectors around six directions, like those of a scene's masks."""
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(6, 32))
    return unit_rows(np.repeat(centres, 10, axis=0) + 0.3 * rng.normal(size=(60, 32))).astype(np.float32)


@pytest.fixture(scope="module")
def texts():
    return unit_rows(np.random.default_rng(1).normal(size=(7, 32))).astype(np.float32)


def blends(features, count):
    """Latents of pixels: averages of a few Gaussians."""
    rng = np.random.default_rng(2)
    weights = rng.dirichlet(np.full(4, 0.5), count)
    return np.einsum("pk,pkd->pd", weights, features[rng.integers(0, len(features), (count, 4))]).astype(
        np.float32
    )


@pytest.mark.parametrize("latent", [3, 8, 11])  # loops take eight channels at a time
def test_linear_codes_need_no_decoding(vectors, texts, latent):
    code = LinearCode.fit(vectors, latent)
    fast = LatentRelevancy(code, texts[:4], 10.0)
    latents = blends(code.encode_array(vectors), 70_000)  # more than one thread takes at a time
    found = fast.fast(fast.prepare(latents), texts[4:])
    assert found == pytest.approx(fast.exact(latents, texts[4:]), abs=1e-5)
    two = LatentRelevancy(code, texts[:4], 10.0, threads=2)
    assert np.array_equal(two.fast(two.prepare(latents), texts[4:]), found)


def test_linear_codes_keep_averages_the_largest_spread_and_at_full_rank_everything(vectors):
    code, mean = LinearCode.fit(vectors, 4), vectors[:10].mean(axis=0, keepdims=True)
    assert code.encode_array(vectors[:10]).mean(axis=0) == pytest.approx(code.encode_array(mean)[0], abs=1e-5)
    full = LinearCode.fit(vectors, 32)
    assert full.decode_array(full.encode_array(vectors)) == pytest.approx(vectors, abs=1e-5)
    assert full.basis @ full.basis.T == pytest.approx(np.eye(32), abs=1e-5)
    rng = np.random.default_rng(3)
    data = (rng.normal(size=(500, 3)) * [0.1, 3.0, 1.0]).astype(np.float32)
    basis = LinearCode.fit(data, 2).basis
    assert np.abs(basis) == pytest.approx(np.array([[0, 1, 0], [0, 0, 1]]), abs=0.05)


def test_texts_looked_up_together_have_the_bytes_of_each_alone(vectors, texts):
    latents = blends(np.random.default_rng(3).normal(size=(60, 9)).astype(np.float32), 5000)
    fast = LatentRelevancy(LinearCode.fit(vectors, 9), texts[:4], 10.0)
    placed = fast.prepare(latents)
    together = fast.fast(placed, texts)
    alone = [fast.fast(placed, texts[row : row + 1])[0] for row in range(len(texts))]
    assert together.tobytes() == np.stack(alone).tobytes()
    assert fast.fast(placed, texts[:0]).shape == (0, len(latents))
    assert fast.fast(fast.prepare(latents[:0]), texts).shape == (len(texts), 0)
