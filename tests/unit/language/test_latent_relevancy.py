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


def test_look_up_is_within_two_thousandths_of_decoding_but_for_few_pixels(vectors, texts):
    code = train_autoencoder(
        vectors, AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=600), 0
    )
    features = code.encode_array(vectors)
    fast = LatentRelevancy(code, texts[:4], 10.0, features)
    latents = blends(features, 3000)
    placed = fast.prepare(latents)
    found = fast.fast(latents, placed, texts[4:])
    exact = fast.exact(latents, texts[4:])
    assert np.ptp(exact) > 0.2  # there is something to get wrong
    errors = np.abs(found - exact)
    assert np.quantile(errors, 0.995) < 2e-3
    assert errors.max() < 1e-2  # a bend of the decoder inside a smallest cell
    two = LatentRelevancy(code, texts[:4], 10.0, features, threads=2)
    assert np.array_equal(two.fast(latents, two.prepare(latents), texts[4:]), found)


def test_cells_of_a_second_view_are_added(vectors, texts):
    code = train_autoencoder(
        vectors, AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=50), 0
    )
    features = code.encode_array(vectors)
    fast = LatentRelevancy(code, texts[:4], 10.0, features)
    latents = blends(features, 400)
    first = fast.prepare(latents[:200])
    second = fast.prepare(latents[200:])
    parts = [fast.fast(latents[:200], first, texts[4:]), fast.fast(latents[200:], second, texts[4:])]
    at_once = LatentRelevancy(code, texts[:4], 10.0, features)
    together = at_once.fast(latents, at_once.prepare(latents), texts[4:])
    assert np.concatenate(parts, axis=1) == pytest.approx(together, abs=1e-4)


@pytest.mark.parametrize("latent", [3, 8])
def test_linear_codes_need_no_decoding(vectors, texts, latent):
    code = LinearCode.fit(vectors, latent)
    fast = LatentRelevancy(code, texts[:4], 10.0, code.encode_array(vectors))
    latents = blends(code.encode_array(vectors), 70_000)  # more than one thread takes at a time
    found = fast.fast(latents, fast.prepare(latents), texts[4:])
    assert found == pytest.approx(fast.exact(latents, texts[4:]), abs=1e-5)
    two = LatentRelevancy(code, texts[:4], 10.0, latents[:1], threads=2)
    assert np.array_equal(two.fast(latents, two.prepare(latents), texts[4:]), found)


def test_networks_of_other_sizes_are_decoded(vectors, texts):
    code = train_autoencoder(
        vectors, AutoencoderSettings(code="network", latent=5, epochs=1, min_steps=50), 0
    )
    fast = LatentRelevancy(code, texts[:4], 10.0, code.encode_array(vectors))
    latents = blends(code.encode_array(vectors), 50)
    assert np.array_equal(
        fast.fast(latents, fast.prepare(latents), texts[4:]), fast.exact(latents, texts[4:])
    )


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
