"""A as an operator against dense algebra, on the CPU and by torch; the two lifts by hand."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.contributions.mask_operator import (
    BLOCK,
    MaskOperator,
    _means,
    _spread,
    lifted_average,
    lifted_median,
)


def random_operator(masks: int = 14, gaussians: int = 30) -> tuple[MaskOperator, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    A = sp.random(masks, gaussians, 0.3, random_state=rng, dtype=np.float32, format="csr")
    level = rng.integers(1, 4, masks).astype(np.uint8)
    return MaskOperator.of(A, level), A.toarray().astype(np.float64), level


def test_means_and_spread_equal_the_dense_products():
    operator, A, level = random_operator()
    rng = np.random.default_rng(1)
    features = rng.normal(size=(30, 3, 4))
    values = rng.normal(size=(14, 4))
    means = np.stack([A[m] @ features[:, level[m] - 1] for m in range(14)])
    assert operator.means(features) == pytest.approx(means, abs=1e-12)
    assert operator.means(features.astype(np.float32)) == pytest.approx(means, abs=1e-5)
    spread = operator.spread(values)
    for index in range(3):
        rows = level == index + 1
        assert spread[:, index] == pytest.approx(A[rows].T @ values[rows], abs=1e-12)
    # adjoint: <A F, x> = <F, A' x>
    assert (means * values).sum() == pytest.approx((features * spread).sum(), rel=1e-12)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("channels", [3, 16, 32])
def test_threads_and_sixteen_channels_at_a_time_give_the_bytes_of_the_plain_loops(channels, threads):
    num_gaussians = 2 * BLOCK + 5
    operator = replace(random_operator(gaussians=num_gaussians)[0], threads=threads)
    rng = np.random.default_rng(2)
    features = rng.normal(size=(num_gaussians, 3, channels)).astype(np.float32)
    values = rng.normal(size=(14, channels)).astype(np.float32)
    A = operator.indptr, operator.indices, operator.data, operator.level_index
    means, spread = np.zeros_like(values), np.zeros_like(features)
    _means(0, 14, *A, features, means)
    _spread(0, num_gaussians, *A, values, spread)
    assert operator.means(features).tobytes() == means.tobytes()
    assert operator.spread(values).tobytes() == spread.tobytes()


def one_gaussian(latents: list[list[float]], weights: list[float]):
    """Masks of level whole that all show one Gaussian."""
    count = len(latents)
    A = sp.csr_matrix(np.array(weights, np.float32)[:, None])
    masks = MaskOperator.of(A, np.ones(count, np.uint8))
    pixels = np.ones(count, np.float32)
    mass = np.array([[sum(weights), 0, 0]], np.float32)
    return masks, mass, pixels, np.array(latents, np.float32)


def test_the_median_passes_over_a_mask_that_is_wrong():
    masks, mass, pixels, latents = one_gaussian([[0, 1], [0, 1], [1, 0]], [1, 1, 1])
    average = lifted_average(masks, mass, pixels, latents)
    assert average[0, 0] == pytest.approx([1 / 3, 2 / 3])
    median = lifted_median(masks, pixels, latents, average)
    assert median[0, 0] == pytest.approx([0, 1], abs=1e-3)
    assert np.array_equal(median[0, 1:], average[0, 1:])  # levels that no mask shows keep the start


def test_the_median_of_a_triangle_sees_its_sides_under_equal_angles():
    # an isosceles triangle: from (0, y) the two lower corners stand 120 degrees apart, y = 1 / sqrt(3)
    masks, mass, pixels, latents = one_gaussian([[-1, 0], [1, 0], [0, 3]], [1, 1, 1])
    median = lifted_median(masks, pixels, latents, lifted_average(masks, mass, pixels, latents), steps=200)
    assert median[0, 0] == pytest.approx([0, 1 / np.sqrt(3)], abs=1e-4)
