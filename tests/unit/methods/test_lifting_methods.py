"""Methods that lift language: worlds of a few pixels and Gaussians whose results are worked out by hand."""

import inspect
import types

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import Level
from hilsplat.baselines import BASELINES, MethodSettings, TrainedSettings
from hilsplat.field.adam import Adam, in_random_order
from hilsplat.field.code import Autoencoder, LinearCode
from hilsplat.methods import dr_splat, langsplat_v2, lifted, occam
from hilsplat.methods.kernels import weighted_sums
from hilsplat.methods.langsplat import train
from hilsplat.methods.method import LabelledView, MethodInputs, run_method
from hilsplat.scene.cameras import Camera


def unit(vectors):
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def test_lifted_averages_masks_by_their_weight_in_a_gaussian():
    # masks of 4 px and 2 px of the wholes, one of 5 px of the parts, on three Gaussians
    means = np.array([[0.75, 0, 0], [0.5, 0.5, 0], [0, 0, 1.0]], np.float32)
    contributions = types.SimpleNamespace(
        matrix={"A": sp.csr_matrix(means)}.get,
        level=np.array([1, 1, 2], np.uint8),
        pixels=np.array([4, 2, 5]),
    )
    latents = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 2.0]], np.float32)
    inputs = types.SimpleNamespace(contributions=contributions, latents=latents)
    features = inspect.unwrap(lifted.fit)(inputs, MethodSettings(name="lifted"), 0)
    # Gaussian 0: (4 * 0.75 * (1, 0) + 2 * 0.5 * (0, 1)) / 4; Gaussian 1 is in mask 1 alone, 2 in no whole
    assert features[:, 0].tolist() == [[0.75, 0.25], [0.0, 1.0], [0.0, 0.0]]
    assert features[:, 1].tolist() == [[0.0, 0.0], [0.0, 0.0], [0.5, 2.0]]
    assert not features[:, 2].any()


# ---- LangSplat ----


@pytest.mark.parametrize("channels", [1, 3, 5])
def test_training_has_the_bytes_of_products_in_scipy(channels):
    rng = np.random.default_rng(channels)
    latents = rng.normal(size=(5, channels)).astype(np.float32)
    views = []
    for number in range(3):
        weights = sp.random(40, 9, 0.4, "csr", np.float32, rng)
        labels = rng.integers(-1, 5, (40, 3)).astype(np.int32)
        views.append(LabelledView(number, np.arange(5), weights, labels, np.zeros((40, 2), int)))
    settings = TrainedSettings(name="langsplat", steps=50)
    features = np.zeros((9, channels), np.float32)
    adam = Adam(features, settings.rate)
    for view in in_random_order(views, np.random.default_rng(4), settings.steps):
        pixels = view.at(Level.PART)
        weights = view.weights[pixels]
        apart = weights @ features - latents[view.labels[pixels, Level.PART.index]]
        adam.step(weights.T @ (np.sign(apart) * np.float32(1 / apart.size)))
    assert np.array_equal(train(views, latents, 9, settings, seed=3)[:, Level.PART.index], features)


def test_weighted_sums_have_the_bytes_of_a_product_in_scipy():
    rng = np.random.default_rng(0)
    weights, features = sp.random(40, 9, 0.4, "csr", np.float32, rng), np.zeros((9, 8), np.float32)
    features[:, :5] = rng.normal(size=(9, 5))
    out = np.full((40, 8), np.nan, np.float32)
    weighted_sums(weights.indptr, weights.indices, weights.data, 8, features.reshape(-1), out.reshape(-1))
    assert np.array_equal(out, weights @ features)


def test_views_are_drawn_in_random_order_each_once_before_any_is_repeated():
    drawn, again, other = (
        list(in_random_order(range(4), np.random.default_rng(seed), 38)) for seed in (0, 0, 3)
    )
    assert all(sorted(drawn[start : start + 4]) == [0, 1, 2, 3] for start in range(0, 36, 4))
    assert len(drawn) == 38 and drawn == again != other


# ---- LangSplatV2 ----


def test_shares_are_the_largest_of_a_softmax_and_the_first_wins_ties():
    logits = np.log(np.float32([[1, 6, 3, 2], [1, 1, 1, 1]]))
    chosen, shares = langsplat_v2.largest_shares(logits, 2)
    assert chosen.tolist() == [[1, 2], [0, 1]]
    assert shares.ravel() == pytest.approx([6 / 9, 3 / 9, 0.5, 0.5])


def test_coordinates_keep_the_angles_of_decoded_vectors():
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(30, 8)) + 2)
    code = LinearCode.fit(vectors, 3)  # fewer directions than the vectors span
    short = unit(langsplat_v2.as_vectors(code.encode_array(vectors), code))
    decoded = code.decode_array(code.encode_array(vectors))
    assert short.shape == (30, 4)
    assert short @ short.T == pytest.approx(decoded @ decoded.T, abs=1e-5)


def test_cosine_loss_matches_hand_computation():
    loss, gradient = langsplat_v2.cosine_loss(np.float32([[3, 4]]), np.float32([[1, 0]]))
    assert loss == pytest.approx(1 - 0.6)
    # (0.6 * (0.6, 0.8) - (1, 0)) / 5
    assert gradient[0] == pytest.approx([-0.128, 0.096])


def test_gradients_of_a_step_match_finite_differences():
    rng = np.random.default_rng(2)
    code = LinearCode.fit(unit(rng.normal(size=(20, 6))), 4)
    weights = rng.random((5, 3))
    weights = sp.csr_matrix((weights / weights.sum(axis=1, keepdims=True)).astype(np.float32))
    pixels = weights, code.encode_array(unit(rng.normal(size=(5, 6))))
    own = [rng.normal(size=shape).astype(np.float32) for shape in [(3, 6), (6, 4)]]  # logits and codebook
    _, *gradients = langsplat_v2.step(*own, *pixels, code)
    chosen, _ = langsplat_v2.largest_shares(own[0])
    for which, place in [(0, (0, chosen[0, 1])), (0, (2, chosen[2, 3])), (1, (chosen[1, 0], 2))]:
        sides = []
        for move in (1e-2, -1e-2):
            moved = [each.copy() for each in own]
            moved[which][place] += move
            sides.append(langsplat_v2.step(*moved, *pixels, code)[0])
        assert gradients[which][place] == pytest.approx((sides[0] - sides[1]) / 2e-2, abs=1e-3)


# ---- Dr. Splat and Occam's LGS ----


AHEAD, BEHIND = np.eye(4), np.diag([1.0, -1, -1, 1])


def one_row_of_pixels(weights, second=AHEAD):
    """Stand-in inputs: two views of a row of eight pixels: the left half is whole 0, the right half whole 1.

    Gaussian i is centred in pixel i; the camera of the second view has the pose `second`.
    """
    labels = np.full((8, 3), -1, np.int32)
    labels[:, Level.WHOLE.index] = np.arange(8) // 4
    weights, K = sp.csr_matrix(weights, dtype=np.float32), np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    contributions = types.SimpleNamespace(
        views=("a", "b"),
        num_gaussians=weights.shape[1],
        level=np.ones(4, np.uint8),
        rows_of_views=lambda: list(np.arange(4).reshape(2, 2)),
        means=lambda: np.float32([[x, 0, 1] for x in range(8)]),
    )
    return types.SimpleNamespace(
        contributions=contributions,
        latents=np.tile(np.eye(2, dtype=np.float32), (2, 1)),
        no_features=lambda: np.zeros((weights.shape[1], 3, 2), np.float32),
        view_weights=lambda view: weights,
        view_labels=lambda view: labels,
        view_camera=lambda view: Camera(view, AHEAD if view == "a" else second, K, (1, 8)),
    )


def test_the_heaviest_weights_of_a_pixel_are_kept_and_the_first_wins_ties():
    weights = sp.csr_matrix(np.float32([[0.1, 0.5, 0.4], [0.3, 0.3, 0.3], [0, 0.2, 0]]))
    kept = dr_splat.heaviest(weights, 2)
    assert kept.toarray() == pytest.approx(np.float32([[0, 0.5, 0.4], [0.3, 0.3, 0], [0, 0.2, 0]]))
    assert weights.nnz == 7  # the given matrix is not changed


def test_only_gaussians_that_dominate_a_pixel_get_its_vector():
    # Gaussian 0 leads the left mask, Gaussian 1 the right one
    inputs = one_row_of_pixels([[0.9, 0.1]] * 4 + [[0.4, 0.6]] * 4)
    vectors = unit(np.array([[1.0, 0.2, 0.0, 0.1], [0.1, 1.0, 0.3, 0.0]] * 2))
    register = inspect.unwrap(dr_splat.register)
    assert register(inputs, vectors, 1)[:, 0] == pytest.approx(vectors[:2], abs=1e-5)
    both = register(inputs, vectors, 45)[:, 0]
    assert both[0] == pytest.approx(unit([0.9 * vectors[0] + 0.4 * vectors[1]])[0], abs=1e-5)


def test_a_quantised_vector_is_the_nearest_entry_of_each_part():
    books = [np.float32([[0] * 4, [1] * 4]), np.float32([[0] * 4, [5, 0, 0, 0]])]
    rows = np.float32([[0.9, 0.8, 1, 1, 4.0], [0.1, 0.2, 0, 0, 0.0]])  # the last three numbers are missing: 0
    assert dr_splat.quantised(rows, books).tolist() == [[1, 1, 1, 1, 5], [0, 0, 0, 0, 0]]


def test_few_vectors_are_quantised_without_loss_and_many_to_less_than_their_spread():
    rng = np.random.default_rng(0)
    few, many = (rng.normal(size=(count, 6)).astype(np.float32) for count in (200, 3000))
    assert dr_splat.quantised(few, dr_splat.codebooks(few, 0)) == pytest.approx(few, abs=1e-6)
    assert np.square(dr_splat.quantised(many, dr_splat.codebooks(many, 0)) - many).mean() < 0.15


def test_centres_have_a_pixel_unless_they_are_behind_or_outside():
    camera = Camera("a", np.eye(4), np.array([[4, 0, 4], [0, 4, 1], [0, 0, 1.0]]), (2, 8))
    means = np.array([[0, 0, 1.0], [-0.5, -0.2, 2.0], [0, 0, -1.0], [2, 0, 1.0], [0, -0.3, 1.0]])
    # (4, 1), (3, 0.6), behind, (12, 1) is outside, (4, -0.2) too
    assert occam.centre_pixels(means, camera).tolist() == [12, 3, -1, -1, -1]


def test_occam_uses_the_mask_at_the_centre_of_a_gaussian_and_ignores_hidden_ones():
    weights = np.eye(8)
    weights[3:5, 3:5] = [[1, 0], [1, 0]]  # Gaussian 3 also covers pixel 4, and hides Gaussian 4 there
    features = inspect.unwrap(occam.fit)(one_row_of_pixels(weights), MethodSettings(name="occam"), 0)
    assert features[3:5, Level.WHOLE.index].tolist() == [[1, 0], [0, 0]]
    assert not features[:, Level.PART.index :].any()
    behind = one_row_of_pixels(weights, second=BEHIND)  # contains no centre
    assert np.array_equal(inspect.unwrap(occam.fit)(behind, MethodSettings(name="occam"), 0), features)


def test_methods_that_average_vectors_refuse_a_network_code(tmp_path, monkeypatch):
    network = Autoencoder.__new__(Autoencoder)
    monkeypatch.setattr("hilsplat.methods.method.load_code", lambda folder: network)
    world = (tmp_path, *[tmp_path / name for name in "abcde"])
    averaging = [name for name, method in BASELINES.items() if method.averages]
    assert set(BASELINES) - set(averaging) == {"langsplat", "hi_lsplat"}  # trained on codes, as published
    for name in averaging:
        with pytest.raises(SettingsError, match=f"method {name} needs a linear code"):
            run_method(MethodInputs(*world), tmp_path / "field", MethodSettings(name=name), 0)
