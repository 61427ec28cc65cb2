"""Look-ups of relevancy against decoding every latent, and the linear code by its algebra."""

import numpy as np
import pytest

from hilsplat.language.autoencoder import train_autoencoder
from hilsplat.language.latent_relevancy import LatentRelevancy
from hilsplat.language.linear_code import LinearCode
from hilsplat.settings import AutoencoderSettings


def unit(vectors):
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def vectors():
    """Sixty vectors about six directions, as a scene's masks have them."""
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(6, 32))
    return unit(np.repeat(centres, 10, axis=0) + 0.3 * rng.normal(size=(60, 32)))


@pytest.fixture(scope="module")
def texts():
    return unit(np.random.default_rng(1).normal(size=(7, 32)))


def blends(features, count):
    """What pixels show: averages of a few Gaussians."""
    rng = np.random.default_rng(2)
    weights = rng.dirichlet(np.full(4, 0.5), count)
    return np.einsum("pk,pkd->pd", weights, features[rng.integers(0, len(features), (count, 4))]).astype(
        np.float32
    )


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
    two = LatentRelevancy(code, texts[:4], 10.0, threads=2)
    assert np.array_equal(two.fast(two.prepare(latents), texts[4:]), found)


def test_a_level_without_a_pixel_has_no_answer(vectors, texts):
    code = train_autoencoder(vectors, AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=1), 0)
    fast = LatentRelevancy(code, texts[:4], 10.0)
    assert fast.fast(fast.prepare(np.zeros((0, 3), np.float32)), texts[4:]).shape == (3, 0)


@pytest.mark.parametrize("latent", [3, 8])
def test_linear_codes_need_no_decoding(vectors, texts, latent):
    code = LinearCode.fit(vectors, latent)
    fast = LatentRelevancy(code, texts[:4], 10.0)
    latents = blends(code.encode_array(vectors), 70_000)  # more than one thread takes at a time
    found = fast.fast(fast.prepare(latents), texts[4:])
    assert found == pytest.approx(fast.exact(latents, texts[4:]), abs=1e-5)
    two = LatentRelevancy(code, texts[:4], 10.0, threads=2)
    assert np.array_equal(two.fast(two.prepare(latents), texts[4:]), found)


def test_a_linear_code_of_full_rank_loses_nothing(vectors):
    code = LinearCode.fit(vectors, 32)
    assert code.decode_array(code.encode_array(vectors)) == pytest.approx(vectors, abs=1e-5)
    assert code.basis @ code.basis.T == pytest.approx(np.eye(32), abs=1e-5)


def test_an_average_of_linear_codes_is_the_code_of_the_average(vectors):
    code = LinearCode.fit(vectors, 4)
    mean = vectors[:10].mean(axis=0, keepdims=True)
    assert code.encode_array(vectors[:10]).mean(axis=0) == pytest.approx(code.encode_array(mean)[0], abs=1e-5)


def test_principal_directions_are_those_of_the_largest_spread():
    rng = np.random.default_rng(3)
    data = (rng.normal(size=(500, 3)) * [0.1, 3.0, 1.0]).astype(np.float32)
    basis = LinearCode.fit(data, 2).basis
    assert np.abs(basis) == pytest.approx(np.array([[0, 1, 0], [0, 0, 1]]), abs=0.05)
