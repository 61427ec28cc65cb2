"""Relevancy by hand, look-ups of it against decoding every latent, and the linear code by its algebra."""

import numpy as np
import pytest

from hilsplat.field.autoencoder import train_autoencoder
from hilsplat.field.code import Autoencoder, LinearCode, unit_rows
from hilsplat.query.relevancy import STEPS, LatentRelevancy, lost_for_error, relevancy
from hilsplat.settings import AutoencoderSettings


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


def pass_through(latent, channels):
    """A network that decodes to the positive part of a latent, then zeros, at unit length."""
    code = Autoencoder.initial(channels, latent, np.random.RandomState(0))
    for name, values in code.arrays.items():
        if name.startswith("decoder"):
            values[:] = np.eye(*values.shape) if values.ndim == 2 else 0
    return code


def distance_from_kept(code, latents, placed):
    """Distance of decoded vectors from their stored form, which bounds the error of any text's cosine."""
    kept = (placed.channels.T / STEPS) @ placed.directions
    return np.linalg.norm(code.decode_array(latents) - kept, axis=1)


@pytest.mark.parametrize("latent", [3, 5])
def test_look_up_of_a_network_is_within_two_thousandths_of_decoding(vectors, texts, latent):
    settings = AutoencoderSettings(code="network", latent=latent, epochs=1, min_steps=600)
    code = train_autoencoder(vectors, settings, 0)
    fast = LatentRelevancy(code, texts[:4], 10.0)
    latents = blends(code.encode_array(vectors), 20_000)  # more than one thread decodes at a time
    placed = fast.prepare(latents)
    found, exact = fast.fast(placed, texts[4:]), fast.exact(latents, texts[4:])
    assert np.ptp(exact) > 0.2  # there is something to get wrong
    assert np.abs(found - exact).max() < 2e-3
    assert len(placed.directions) < 32
    assert distance_from_kept(code, latents, placed).max() < 8e-4  # 4 x 2e-3 / 10: so for any text
    two = LatentRelevancy(code, texts[:4], 10.0, threads=2)
    assert np.array_equal(two.fast(two.prepare(latents), texts[4:]), found)


@pytest.mark.parametrize(("height", "directions"), [(6e-4, 2), (7e-4, 3), (1, 3)])
def test_a_small_object_gets_a_direction_unless_its_component_is_below_the_error_bound(height, directions):
    # By hand: 4 x 2e-3 / 10 - sqrt(128) / (2 x 32767) = 6.27e-4
    assert lost_for_error(10.0, 128) == pytest.approx(6.27e-4, abs=1e-6)
    # 50,000 px between two directions; 10 px, which a sample of every 7th misses, have part of a third
    share = np.linspace(0, 1, 50_000, dtype=np.float32)
    latents = np.stack([share, 1 - share, np.zeros_like(share)], axis=1)
    latents[[p for p in range(100, 115) if p % 7][:10]] = [1, 0, height]
    code, axes = pass_through(3, 128), np.eye(128, dtype=np.float32)
    fast = LatentRelevancy(code, axes[3:4], 10.0)
    placed = fast.prepare(latents)
    assert len(placed.directions) == directions
    # Relevancy is steepest at a tie with the phrase, and this text is the lost direction: the worst case.
    assert np.abs(fast.fast(placed, axes[2:3]) - fast.exact(latents, axes[2:3])).max() < 2e-3


def test_repeatedly_missed_objects_are_found_until_all_channels_are_directions(monkeypatch):
    monkeypatch.setattr("hilsplat.query.relevancy.SAMPLE", 4)
    latents = np.zeros((4000, 8), np.float32)  # the sample takes every 1000th
    latents[:, 0] = 1
    latents[101:201, 1] = 1  # the sample of these 100 takes every 25th
    latents[[103, 108, 111, 115, 119, 123], 2:] = np.eye(6)
    code, axes = pass_through(8, 8), np.eye(8, dtype=np.float32)
    fast = LatentRelevancy(code, axes[:1], 10.0)
    placed = fast.prepare(latents)
    assert distance_from_kept(code, latents, placed).max() < 8e-4
    assert placed.directions @ placed.directions.T == pytest.approx(axes, abs=1e-6)
    assert placed.channels.shape == (8, 4000)
    assert placed.channels.base is None  # no larger array stays in memory


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
    for code in (LinearCode.fit(vectors, 9), pass_through(9, 32)):
        fast = LatentRelevancy(code, texts[:4], 10.0)
        placed = fast.prepare(latents)
        together = fast.fast(placed, texts)
        alone = [fast.fast(placed, texts[row : row + 1])[0] for row in range(len(texts))]
        assert together.tobytes() == np.stack(alone).tobytes()
        assert fast.fast(placed, texts[:0]).shape == (0, len(latents))
        assert fast.fast(fast.prepare(latents[:0]), texts).shape == (len(texts), 0)
