"""Baselines: small matrices worked by hand, and the example in the documentation, run from its text."""

import inspect
import itertools
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.base.levels import LEVELS, Level
from hilsplat.field.adam import Adam
from hilsplat.methods import langsplat, lifted, registry, stage
from hilsplat.methods.common.pixels import LabelledView, grid_pixels, in_random_order
from hilsplat.methods.langsplat import l1_gradient, train_level
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.methods.registry import METHODS, OURS, method_of, require_method
from hilsplat.settings import MethodSettings
from tests.conftest import PROJECT

EXTENDING = PROJECT / "docs" / "extending.md"


def fit_of(method, inputs, settings):
    """The field of a method, from stand-ins for MethodInputs."""
    return inspect.unwrap(method.fit)(inputs, settings, 0)


def test_a_gaussian_gets_the_average_of_its_masks_weighed_by_their_share_of_it():
    # masks of 4 px and 2 px of the wholes, one of 5 px of the parts, on three Gaussians
    means = np.array([[0.75, 0, 0], [0.5, 0.5, 0], [0, 0, 1.0]], np.float32)
    contributions = types.SimpleNamespace(
        matrix={"A": sp.csr_matrix(means)}.get,
        level=np.array([1, 1, 2], np.uint8),
        pixels=np.array([4, 2, 5]),
    )
    latents = np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 2.0]], np.float32)
    inputs = types.SimpleNamespace(contributions=contributions, latents=latents)
    features = fit_of(lifted.METHOD, inputs, MethodSettings(name="lifted"))
    # Gaussian 0: (4 * 0.75 * (1, 0) + 2 * 0.5 * (0, 1)) / 4; Gaussian 1 is in mask 1 alone, 2 in no whole
    assert features[:, 0].tolist() == [[0.75, 0.25], [0.0, 1.0], [0.0, 0.0]]
    assert features[:, 1].tolist() == [[0.0, 0.0], [0.0, 0.0], [0.5, 2.0]]
    assert not features[:, 2].any()


def l1_by_scipy(features, weights, targets):
    """Gradient of the mean absolute difference of rendered and painted codes by the features, by scipy."""
    apart = weights @ features - targets
    scale = np.float32(1 / max(apart.size, 1))
    return (weights.T @ (np.sign(apart) * scale)).astype(np.float32)


def test_l1_gradient_is_the_slope_of_the_mean_absolute_difference_of_labelled_pixels():
    rng = np.random.default_rng(0)
    weights = sp.csr_matrix(rng.random((5, 4)).astype(np.float32))
    labels, codes = np.array([1, -1, 0, 2, 1], np.int32), rng.normal(size=(3, 2))
    features = rng.random((4, 2))

    def loss(features):
        apart = (weights @ features)[labels >= 0] - codes[labels[labels >= 0]]
        return np.abs(apart).mean()

    flat = [np.pad(rows, ((0, 0), (0, 2))).ravel().astype(np.float32) for rows in (codes, features)]
    gradient = np.full(4 * 4, 9, np.float32)  # what a step before left there
    l1_gradient(weights.indptr, weights.indices, weights.data, labels, flat[0], 2, 4, flat[1], gradient)
    slope = np.zeros((4, 4))
    for place in np.ndindex(4, 2):
        step = np.zeros_like(features)
        step[place] = 1e-6
        slope[place] = (loss(features + step) - loss(features - step)) / 2e-6
    assert gradient.reshape(4, 4) == pytest.approx(slope, abs=1e-5)
    assert (np.abs(slope[:, :2]) > 0.01).any(axis=0).all()


def adam_in_numpy(values, gradients, rate):
    """Adam in place, a step for each gradient, which may be computed from the values of that step."""
    first, second = np.zeros_like(values), np.zeros_like(values)
    for step, gradient in enumerate(gradients, 1):
        first[:] = np.float32(0.9) * first + np.float32(1 - 0.9) * gradient
        second[:] = np.float32(0.999) * second + np.float32(1 - 0.999) * gradient * gradient
        scale = np.float32((1 - 0.999**step) ** -0.5)
        values -= np.float32(rate / (1 - 0.9**step)) * first / (np.sqrt(second) * scale + np.float32(1e-15))


def test_adam_has_the_bytes_of_its_formula_in_numpy():
    rng = np.random.default_rng(6)
    gradients = rng.normal(size=(40, 7, 3)).astype(np.float32)
    gradients[:, 0] = 0
    expected, found = np.ones((2, 7, 3), np.float32)
    adam_in_numpy(expected, gradients, 0.01)
    adam = Adam(found, 0.01)
    for gradient in gradients:
        adam.step(gradient)
    assert np.array_equal(found, expected) and (found[0] == 1).all() and (found[1:] != 1).all()


def painted(weights, labels):
    """A view whose masks are the first rows of the contributions."""
    rows = np.arange(labels.max() + 1)
    return LabelledView(
        0, rows, sp.csr_matrix(weights, dtype=np.float32), labels, np.zeros((len(labels), 2), int)
    )


def whole_masks(num):
    """Labels of pixels that each have a mask of the wholes."""
    labels = np.full((num, 3), -1, np.int32)
    labels[:, Level.WHOLE.index] = np.arange(num)
    return labels


@pytest.mark.parametrize("channels", [1, 3, 4, 6])
def test_training_has_the_bytes_of_products_with_the_matrix_and_of_adam_in_numpy(channels):
    rng = np.random.default_rng(channels)
    latents = rng.normal(size=(5, channels)).astype(np.float32)
    views = [
        painted(sp.random(40, 9, 0.4, "csr", np.float32, rng), rng.integers(-1, 5, (40, 3)).astype(np.int32))
        for _ in range(3)
    ]
    settings = MethodSettings(name="langsplat", steps=50)
    features, order = np.zeros((9, channels), np.float32), np.random.default_rng(4)
    drawn = np.concatenate([order.permutation(3)[::-1] for _ in range(17)])[: settings.steps]

    def gradients():
        for view in (views[number] for number in drawn):
            pixels = view.at(Level.PART)
            yield l1_by_scipy(features, view.weights[pixels], latents[view.labels[pixels, Level.PART.index]])

    adam_in_numpy(features, gradients(), settings.rate)
    assert np.array_equal(train_level(views, latents, Level.PART, 9, settings, seed=4), features)


def test_a_code_that_is_no_number_is_not_trained_on_in_silence():
    view, latents = painted(np.ones((1, 1)), whole_masks(1)), np.float32([[np.nan]])
    settings = MethodSettings(name="langsplat", steps=2)
    assert np.isnan(train_level([view], latents, Level.WHOLE, 1, settings, seed=0)).all()


def test_l1_finds_the_median_of_what_a_gaussian_shows():
    # one Gaussian alone in three pixels with codes 0, 1 and 10: the squared optimum would be 11/3
    view, latents = painted(np.ones((3, 1)), whole_masks(3)), np.float32([[0], [1], [10]])
    settings = MethodSettings(name="langsplat", steps=2000, rate=0.005)
    found = train_level([view], latents, Level.WHOLE, 1, settings, seed=0)
    assert found[0, 0] == pytest.approx(1.0, abs=0.02)


def test_views_come_in_random_order_each_once_before_any_is_repeated():
    first, again, other = (in_random_order(range(4), np.random.default_rng(seed)) for seed in (0, 0, 3))
    drawn = list(itertools.islice(first, 40))
    assert all(sorted(drawn[start : start + 4]) == [0, 1, 2, 3] for start in range(0, 40, 4))
    assert drawn == list(itertools.islice(again, 40)) != list(itertools.islice(other, 40))


def test_the_pixels_of_a_level_are_those_that_it_labels():
    view = painted(np.eye(3), np.array([[1, -1, -1], [0, 2, -1], [-1, 0, -1]], np.int32))
    assert [view.at(level).tolist() for level in LEVELS] == [[0, 1], [1, 2], []]


def test_langsplat_trains_every_level_on_the_pixels_of_the_grid():
    # one row of five pixels, every second one compared: 0, 2 and 4; pixel 4 is not covered
    weights = sp.csr_matrix(np.array([[1, 0], [1, 0], [0, 1], [0, 1], [0, 0]], np.float32))
    labels = np.array([[0, 2, -1], [1, 2, -1], [0, -1, -1], [1, 2, 1], [1, 1, 1]], np.int32)
    inputs = MethodInputs(*[Path("none")] * 5)
    inputs.__dict__.update(
        contributions=types.SimpleNamespace(
            views=("a", "b"), num_gaussians=2, rows_of_views=lambda: [np.array([0]), np.array([1, 2, 3])]
        ),
        latents=np.array([[9.0], [0.3], [5.0], [0.6]], np.float32),  # view b has the last three
        view_weights=lambda view: weights,
        view_labels=lambda view: labels if view == "b" else np.full((5, 3), -1, np.int32),
        view_camera=lambda view: types.SimpleNamespace(size_hw=(1, 5)),
    )
    settings = MethodSettings(name="langsplat", steps=900, rate=0.002, pixel_step=2)
    features = fit_of(langsplat.METHOD, inputs, settings)[..., 0]
    assert features[:, Level.WHOLE.index] == pytest.approx([0.3, 0.3], abs=0.01)
    assert features[:, Level.PART.index] == pytest.approx([0.6, 0.0], abs=0.01)
    assert features[:, Level.SUBPART.index].tolist() == [0, 0]


def test_grid_takes_every_second_pixel_of_every_second_row():
    assert grid_pixels((3, 4), 2).tolist() == [0, 2, 8, 10]


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_baseline_is_named_after_its_file_and_says_where_it_comes_from(name):
    method = method_of(name)
    assert METHODS.places[name] == f"hilsplat.methods.{name}:METHOD" and method.name == name
    assert method.source


def test_unknown_methods_name_those_that_exist():
    with pytest.raises(SettingsError, match=rf"one of hilsplat, .*{', '.join(METHODS)}"):
        require_method("langsplatt")
    require_method(OURS)
    with pytest.raises(SettingsError, match="is not a baseline"):
        method_of(OURS)


@pytest.mark.parametrize("features", [np.zeros((2, 3, 2)), np.full((2, 3, 1), np.nan)])
def test_a_method_that_returns_no_field_is_refused(tmp_path, monkeypatch, features):
    broken = Method("lifted", "broken", "none", lambda inputs, settings, seed: features)
    monkeypatch.setattr(stage, "method_of", lambda name: broken)
    inputs = types.SimpleNamespace(
        scene_folder=tmp_path / "scene",
        contributions=types.SimpleNamespace(num_gaussians=2),
        latents=np.zeros((3, 1), np.float32),
    )
    with pytest.raises(ArtifactError, match="method lifted did not return a language field"):
        run_method = inspect.unwrap(stage.run_method)  # the inputs here are no MethodInputs
        run_method(inputs, tmp_path / "field.safetensors", MethodSettings(name="lifted"), 0)


def test_the_method_of_the_documentation_runs_as_it_is_written(tmp_path, monkeypatch):
    """The code block of docs/extending.md becomes a module, one line the registry, and it writes a field."""
    code = re.search(r"```python\n(# hilsplat/methods/nearest_mask\.py.*?)```", EXTENDING.read_text(), re.S)
    line = re.search(r'```python\n(    "nearest_mask": .*?)\n```', EXTENDING.read_text(), re.S)
    module = types.ModuleType("hilsplat.methods.nearest_mask")
    exec(compile(code[1], "nearest_mask.py", "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    name, place = (part.strip(' ",') for part in line[1].split(":", 1))
    monkeypatch.setitem(registry.METHODS.places, name, place)

    means = sp.csr_matrix(np.array([[0.9, 0.1], [0.2, 0.3]], np.float32))
    contributions = types.SimpleNamespace(
        num_gaussians=2,
        matrix=lambda _: means,
        pixels=np.array([1, 4]),
        rows_of=lambda level: np.array([0, 1]),
    )
    inputs = types.SimpleNamespace(
        contributions=contributions, latents=np.array([[1.0, 0.0], [0.0, 1.0]], np.float32)
    )
    features = method_of("nearest_mask").fit(inputs, MethodSettings(name="nearest_mask"), 0)
    # Gaussian 0: 0.9 px in mask 0, 0.8 px in mask 1; Gaussian 1: 0.1 px and 1.2 px
    assert features[:, 0].tolist() == [[1.0, 0.0], [0.0, 1.0]]
