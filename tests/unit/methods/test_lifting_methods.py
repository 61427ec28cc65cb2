"""Methods that lift language: worlds of a few pixels and Gaussians in which the right answer is known."""

import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import Level
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.field.linear_code import LinearCode
from hilsplat.field.network_code import Autoencoder
from hilsplat.methods import dr_splat, occam
from hilsplat.methods.common.quantise import ProductQuantiser
from hilsplat.methods.langsplat_v2 import as_vectors, cosine_loss, largest_shares, step
from hilsplat.methods.method import MethodInputs
from hilsplat.methods.registry import method_of
from hilsplat.scene.cameras import Camera
from hilsplat.settings import MethodSettings

WIDTH = 8


def unit(vectors):
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


class OneRowOfPixels(MethodInputs):
    """Views of one row of eight pixels; Gaussian i is alone in pixel i, but `weights` may say otherwise.

    The left half is mask 0, the right half mask 1, both whole; parts and subparts have no mask.
    """

    def __init__(self, vectors, views=("a", "b"), weights=None):
        super().__init__(*[Path("none")] * 5)
        own = self.__dict__  # the class is frozen
        own["weights"] = weights = (
            sp.csr_matrix(np.eye(WIDTH, dtype=np.float32)) if weights is None else weights
        )
        labels = np.full((WIDTH, 3), -1, np.int32)
        labels[:, Level.WHOLE.index] = np.arange(WIDTH) // (WIDTH // 2)
        own["labels"], own["code"] = labels, LinearCode.fit(vectors, vectors.shape[1])
        own["latents"] = self.code.encode_array(np.tile(vectors, (len(views), 1)))
        shown = painted_indicator(labels, 2, np.ones(WIDTH, bool))
        pixels = np.diff(shown.indptr).astype(np.int64)
        one = sp.diags(1 / np.maximum(pixels, 1)) @ shown @ weights
        level = np.full(2 * len(views), int(Level.WHOLE), np.uint8)
        means = sp.vstack([one] * len(views)).tocsr().astype(np.float32)
        own["contributions"] = types.SimpleNamespace(
            views=views,
            num_gaussians=weights.shape[1],
            rows_of_views=lambda: list(np.arange(2 * len(views)).reshape(-1, 2)),
            level=level,
            pixels=np.tile(pixels, len(views)),
            rows_of=lambda requested: np.flatnonzero(level == int(requested)),
            matrix={"A": means}.get,
            means=lambda: np.column_stack([np.arange(WIDTH), np.zeros(WIDTH), np.ones(WIDTH)]).astype(
                np.float32
            ),
        )

    def view_weights(self, view):
        return self.weights

    def view_labels(self, view):
        return self.labels

    def view_camera(self, view):
        return Camera(view, np.eye(4), np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]]), (1, WIDTH))

    def linear_code(self, method):
        return self.code


TWO = unit(np.array([[1.0, 0.2, 0.0, 0.1], [0.1, 1.0, 0.3, 0.0]]))
SETTINGS = {
    "langsplat_v2": {"steps": 150, "rate": 0.05, "pixel_step": 1},
    "dr_splat": {},
    "occam": {},
}


def fit_of(name, inputs, seed=0, **knobs):
    settings = MethodSettings(name=name, **(SETTINGS[name] | knobs))
    return method_of(name).fit(inputs, settings, seed)


@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_a_gaussian_in_one_mask_gets_its_vector_and_one_in_none_gets_zeros(name):
    inputs = OneRowOfPixels(TWO)
    features = fit_of(name, inputs)
    answers = inputs.code.decode_array(features[:, Level.WHOLE.index])
    truth = TWO[np.arange(WIDTH) // (WIDTH // 2)]
    assert (answers * truth).sum(axis=1) == pytest.approx(1, abs=2e-3)
    assert not features[:, Level.PART.index :].any()


@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_the_same_seed_gives_the_same_bytes(name):
    first, again = (fit_of(name, OneRowOfPixels(TWO), seed=3) for _ in range(2))
    assert first.tobytes() == again.tobytes()


# ---- LangSplatV2 ----------------------------------------------------------------------------------------


def test_the_largest_shares_are_those_of_a_softmax_and_of_equal_logits_the_first():
    logits = np.log(np.float32([[1, 6, 3, 2], [1, 1, 1, 1]]))
    chosen, shares = largest_shares(logits, 2)
    assert chosen.tolist() == [[1, 2], [0, 1]]
    assert shares.ravel() == pytest.approx([6 / 9, 3 / 9, 0.5, 0.5])


def test_coordinates_keep_the_angles_of_decoded_vectors():
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(30, 8)) + 2)
    code = LinearCode.fit(vectors, 3)  # fewer directions than the vectors span
    short = unit(as_vectors(code.encode_array(vectors), code))
    decoded = code.decode_array(code.encode_array(vectors))
    assert short.shape == (30, 4)
    assert short @ short.T == pytest.approx(decoded @ decoded.T, abs=1e-5)


def test_cosine_loss_matches_hand_computation():
    loss, gradient = cosine_loss(np.float32([[3, 4]]), np.float32([[1, 0]]))
    assert loss == pytest.approx(1 - 0.6)
    # (0.6 * (0.6, 0.8) - (1, 0)) / 5
    assert gradient[0] == pytest.approx([-0.128, 0.096])


def test_gradients_of_a_step_match_finite_differences():
    rng = np.random.default_rng(2)
    code = LinearCode.fit(unit(rng.normal(size=(20, 6))), 4)
    weights = rng.random((5, 3))
    weights = sp.csr_matrix((weights / weights.sum(axis=1, keepdims=True)).astype(np.float32))
    pixels = weights, code.encode_array(unit(rng.normal(size=(5, 6))))
    logits, codebook = (rng.normal(size=shape).astype(np.float32) for shape in [(3, 6), (6, 4)])
    _, by_logits, by_codebook = step(logits, codebook, *pixels, code)
    chosen, _ = largest_shares(logits)
    for which, values, gradient, place in [
        (0, logits, by_logits, (0, chosen[0, 1])),
        (0, logits, by_logits, (2, chosen[2, 3])),
        (1, codebook, by_codebook, (chosen[1, 0], 2)),
    ]:
        sides = []
        for sign in (1, -1):
            moved = values.copy()
            moved[place] += sign * 1e-2
            sides.append(step(*((moved, codebook) if which == 0 else (logits, moved)), *pixels, code)[0])
        assert gradient[place] == pytest.approx((sides[0] - sides[1]) / 2e-2, abs=1e-3)


# ---- Dr. Splat ------------------------------------------------------------------------------------------


def test_the_heaviest_weights_of_a_pixel_stay_and_of_equal_ones_the_first():
    weights = sp.csr_matrix(np.float32([[0.1, 0.5, 0.4], [0.3, 0.3, 0.3], [0, 0.2, 0]]))
    kept = dr_splat.heaviest(weights, 2)
    assert kept.toarray() == pytest.approx(np.float32([[0, 0.5, 0.4], [0.3, 0.3, 0], [0, 0.2, 0]]))
    assert weights.nnz == 7  # the given matrix is not changed


def test_only_gaussians_that_lead_a_pixel_take_its_vector():
    weights = np.zeros((WIDTH, 2), np.float32)
    weights[:4] = [0.9, 0.1]  # Gaussian 0 leads the left mask,
    weights[4:] = [0.4, 0.6]  # Gaussian 1 the right one
    inputs = OneRowOfPixels(TWO, weights=sp.csr_matrix(weights))
    leaders = dr_splat.register(inputs, inputs.code.decode_array(inputs.latents), 1)[:, 0]
    assert leaders == pytest.approx(TWO, abs=1e-5)
    both = dr_splat.register(inputs, inputs.code.decode_array(inputs.latents), 45)[:, 0]
    assert both[0] == pytest.approx(unit([0.9 * TWO[0] + 0.4 * TWO[1]])[0], abs=1e-5)


def test_a_quantised_vector_is_the_nearest_centroid_of_each_part():
    codebooks = np.float32([[[0, 0], [1, 1]], [[0, 0], [5, 0]]])
    quantiser = ProductQuantiser(codebooks)
    codes = quantiser.encode(
        np.float32([[0.9, 0.8, 4.0], [0.1, 0.2, 0.0]])
    )  # the fourth number is missing: 0
    assert codes.dtype == np.uint8 and codes.tolist() == [[1, 1], [0, 0]]
    assert quantiser.decode(codes, 3).tolist() == [[1, 1, 5], [0, 0, 0]]


def test_few_vectors_are_quantised_without_loss_and_many_to_less_than_their_spread():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(200, 6)).astype(np.float32)
    quantiser = ProductQuantiser.fit(few, 4, seed=0)
    assert quantiser.decode(quantiser.encode(few), 6) == pytest.approx(few, abs=1e-6)
    many = rng.normal(size=(3000, 6)).astype(np.float32)
    quantiser = ProductQuantiser.fit(many, 4, seed=0)
    assert np.square(quantiser.decode(quantiser.encode(many), 6) - many).mean() < 0.15


# ---- Occam's LGS ----------------------------------------------------------------------------------------


def test_centres_fall_into_pixels_unless_they_are_behind_or_outside():
    camera = Camera("a", np.eye(4), np.array([[4, 0, 4], [0, 4, 1], [0, 0, 1.0]]), (2, 8))
    means = np.array([[0, 0, 1.0], [-0.5, -0.2, 2.0], [0, 0, -1.0], [2, 0, 1.0], [0, -0.3, 1.0]])
    # (4, 1), (3, 0.6), behind, (12, 1) is outside, (4, -0.2) too
    assert occam.centre_pixels(means, camera).tolist() == [12, 3, -1, -1, -1]


def test_a_gaussian_across_a_border_takes_the_mask_at_its_centre_and_a_hidden_one_nothing():
    weights = np.eye(WIDTH, dtype=np.float32)
    weights[3], weights[4] = 0, 0
    weights[3:5, 3] = 1  # Gaussian 3 covers pixel 4 as well, and hides Gaussian 4 there
    inputs = OneRowOfPixels(TWO, weights=sp.csr_matrix(weights))
    features = fit_of("occam", inputs)[:, Level.WHOLE.index]
    assert inputs.code.decode_array(features[3:4])[0] == pytest.approx(TWO[0], abs=1e-5)
    assert not features[4].any()
    masks = MaskOperator.of(inputs.contributions.matrix("A"), inputs.contributions.level)
    assert (
        masks.spread(np.ones((4, 1), np.float32))[3] > 0
    ).any()  # which `lifted` would divide between both


def test_a_view_in_which_no_centre_lies_adds_nothing():
    class LooksAway(OneRowOfPixels):
        def view_camera(self, view):
            camera = super().view_camera(view)
            return replace(camera, cam_from_world=np.diag([1.0, -1, -1, 1])) if view == "b" else camera

    assert np.array_equal(fit_of("occam", LooksAway(TWO)), fit_of("occam", OneRowOfPixels(TWO, views=("a",))))


# ---- what they need -------------------------------------------------------------------------------------


def test_methods_of_vectors_refuse_a_code_that_is_a_network(tmp_path, monkeypatch):
    network = Autoencoder.__new__(Autoencoder)
    monkeypatch.setattr("hilsplat.methods.method.load_code", lambda folder: network)
    inputs = MethodInputs(*[tmp_path] * 5)
    with pytest.raises(SettingsError, match="method dr_splat needs a linear code"):
        inputs.linear_code("dr_splat")


def test_training_free_lifting_is_not_random():
    assert [name for name in ("hilsplat", "lifted", "occam") if MethodSettings(name=name).is_random] == []
    assert MethodSettings(name="dr_splat").is_random and MethodSettings(name="langsplat_v2").is_random
