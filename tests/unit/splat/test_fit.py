"""The fit of a scene of three Gaussians, and its two strategies."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from cpusplat.views import Parameters
from hilsplat.base.artifacts import read_index, read_json, read_npz, write_arrays
from hilsplat.base.errors import SceneError
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat import fit
from hilsplat.splat.densify import (
    densify,
    opacities,
    prune,
    relocate_and_grow,
    reset_opacities,
    scale_factor,
    shared_opacity,
)
from hilsplat.splat.gaussians import morton_order
from hilsplat.splat.initial import RANDOM_POINTS, first_gaussians
from hilsplat.splat.model import Model, means_rate, step_sizes
from hilsplat.splat.ply import load_ply
from hilsplat.splat.steps import fit_steps
from tests.unit.round_gaussians import round_gaussians
from tests.unit.splat.three_gaussians_world import mean_psnr, three_gaussians_scene

SETTINGS = GaussiansSettings(
    iterations=60, densify_every=10, checkpoint_every=25, sh_degree=1, max_gaussians=400
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    return three_gaussians_scene(tmp_path_factory.mktemp("three") / "scene")


@pytest.mark.parametrize(("views", "steps"), [(3, 1500), (25, 1500), (26, 1560), (60, 3000)])
def test_the_steps_of_a_fit_grow_with_the_views_between_two_bounds(views, steps):
    assert fit_steps(GaussiansSettings(), views) == steps
    assert fit_steps(GaussiansSettings(iterations=600), views) == 600


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_fit_improves_held_out_views(scene, strategy):
    settings = SETTINGS.model_copy(update={"strategy": strategy})
    first, _ = fit.fit_gaussians(scene, settings.model_copy(update={"iterations": 1}), seed=0)
    last, curve = fit.fit_gaussians(scene, settings.model_copy(update={"iterations": 200}), seed=0)
    assert mean_psnr(scene, last) > mean_psnr(scene, first) + 5
    assert len(last) <= SETTINGS.max_gaussians
    assert curve[-1, 0] == 200
    assert np.array_equal(morton_order(last.means), np.arange(len(last)))


@pytest.fixture
def stage(scene, tmp_path, monkeypatch):
    """A function that runs the stage, up to a step, and returns its files; and the steps of its last run."""
    step, steps = fit.fit_step, []

    def run(name: str, settings: GaussiansSettings, threads: int = 1, stop: int = 60) -> dict[str, bytes]:
        def counted(state, *rest):
            if state.model.steps == stop:
                raise KeyboardInterrupt
            steps.append(state.model.steps)
            step(state, *rest)

        steps.clear()
        monkeypatch.setattr(fit, "fit_step", counted)
        out, cache = tmp_path / name, tmp_path / "cache"
        fit.run_gaussians(scene.folder, out / "g.ply", out / "report", cache, settings, 3, threads)
        return {path.name: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    return run, steps


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_threads_and_interruptions_do_not_change_the_bytes(stage, tmp_path, monkeypatch, strategy):
    settings = SETTINGS.model_copy(update={"strategy": strategy, "background": "random"})
    run, steps = stage
    undisturbed = run("one", settings)
    assert undisturbed == run("two", settings, threads=2)
    assert set(undisturbed) == {
        *("g.ply", "g.json", "report.json", "curves.png", "test_views.png"),
        *("flyaround.png", "flyaround.mp4", "index.json"),
    }
    assert not list((tmp_path / "cache").rglob("*.npz"))
    with pytest.raises(KeyboardInterrupt):
        run("stopped", settings, stop=40)
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 1
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(fit, "fit_device", lambda *arguments: "cuda")
        patch.setattr(fit, "model_on", lambda device: Model)
        run("another device", settings, stop=0)  # a fit doesn't resume on it
    assert run("resumed", settings) == undisturbed
    assert steps[0] == 25
    assert not list((tmp_path / "cache").rglob("*.npz"))
    index = read_index(tmp_path / "resumed" / "report")
    assert index["split"] == "test"
    assert list(index["views"]) == ["003.png", "007.png"]
    assert len(load_ply(tmp_path / "resumed" / "g.ply")) == index["gaussians"]
    coordinates = read_json(tmp_path / "resumed" / "g.json")
    assert coordinates["source"] == "imported from sparse/0"
    assert coordinates["unit"] == "arbitrary"
    assert coordinates["scale"] == 1.0
    assert coordinates["origin"] == {"kind": "fitted", "strategy": strategy, "iterations": 60, "seed": 3}


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays: arrays.pop("steps"),
        lambda arrays: arrays.update(generator=np.array("[]")),
        lambda arrays: arrays.update(generator=np.array("{")),
        lambda arrays: arrays.update(generator=np.array(7)),
    ],
)
def test_a_checkpoint_with_other_content_is_ignored(scene, tmp_path, change):
    generator, cameras = np.random.default_rng(0), [scene.cameras[view] for view in scene.views("train")]
    model = Model(first_gaussians(scene, cameras, SETTINGS, generator))
    path = tmp_path / f"{'0' * 16}.npz"
    fit.FitState(model, generator).save(path)
    assert fit.FitState.load(path, Model, 1) is not None
    arrays = read_npz(path)
    change(arrays)
    write_arrays(path, arrays, compressed=False)
    assert fit.FitState.load(path, Model, 1) is None


def test_random_points_are_in_view_of_cameras(scene):
    cameras = [scene.cameras[name] for name in scene.views("train")]
    settings = GaussiansSettings(initial="random")
    first = first_gaussians(scene, cameras, settings, np.random.default_rng(0))
    assert len(first["means"]) == RANDOM_POINTS
    seen = np.zeros(RANDOM_POINTS, bool)
    for camera in cameras:
        at = first["means"] @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        pixel = at[:, :2] / at[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
        seen |= (at[:, 2] > 0) & (pixel > -1e-3).all(axis=1) & (pixel < 48 + 1e-3).all(axis=1)
    assert seen.all()


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_frozen_gaussians_stay_at_their_points(scene, strategy):
    points = np.random.default_rng(0).normal(0, 0.3, (150, 3)).astype(np.float32)
    bare = replace(scene, points_xyz=points, points_rgb=np.full((150, 3), 128, np.uint8))
    few = {"initial": "frozen", "max_gaussians": 100, "strategy": strategy, "opacity_reset_every": 20}
    settings = SETTINGS.model_copy(update=few)
    gaussians, curve = fit.fit_gaussians(bare, settings, seed=0)
    assert np.array_equal(gaussians.means, points)
    assert curve[-1, 2] > curve[0, 2]  # colours, sizes and opacities are still fitted
    assert len(set(gaussians.opacities.round(3))) > 50


@pytest.mark.parametrize(
    ("first_x", "num_points", "split", "changes", "message"),
    [
        (np.nan, 8, "train", {"initial": "frozen"}, "gaussians.initial: frozen"),
        (0.0, 0, "train", {"initial": "frozen"}, "gaussians.initial: frozen"),
        (0.0, 8, "test", {}, "no training view"),
        (0.0, 8, "train", {"iterations": 1, "min_opacity": 0.2}, "all Gaussians of toy/three became transp"),
    ],
    ids=["not finite", "no points", "all held out", "all pruned at the end"],
)
def test_a_scene_that_cannot_be_fitted_is_refused(scene, first_x, num_points, split, changes, message):
    xyz = scene.points_xyz.copy()
    xyz[0, 0] = first_x
    points = {"points_xyz": xyz[:num_points], "points_rgb": scene.points_rgb[:num_points]}
    bare = replace(scene, split={**scene.split, **dict.fromkeys(scene.views("train"), split)}, **points)
    with pytest.raises(SceneError, match=message):
        fit.fit_gaussians(bare, SETTINGS.model_copy(update=changes), seed=0)


def test_images_grow_from_a_quarter_to_their_size():
    def scales(side_px: int, **shares: float) -> list[float]:
        settings = GaussiansSettings(**shares)
        return [fit.scale_at(settings, at, side_px) for at in (0.0, 0.19, 0.2, 0.59, 0.6, 1.0)]

    assert scales(400, quarter_until=0.2, half_until=0.6) == [0.25, 0.25, 0.5, 0.5, 1, 1]
    assert scales(200, quarter_until=0.2, half_until=0.6) == [0.5, 0.5, 0.5, 0.5, 1, 1]  # a quarter is 50 px
    assert scales(100, quarter_until=0.2, half_until=0.6) == [1] * 6
    assert scales(400, quarter_until=0, half_until=0) == [1] * 6


def test_rate_of_the_means_falls_exponentially():
    settings = GaussiansSettings(means_rate=1e-2, means_rate_last=1e-4)
    assert [means_rate(settings, at) for at in (0.0, 0.5, 1.0)] == pytest.approx([1e-2, 1e-3, 1e-4])


def two_gaussians() -> dict[str, np.ndarray]:
    """A small one (largest axis 0.001) and a large one (0.1)."""
    two = vars(round_gaussians(np.array([[0, 0, 0], [1, 0, 0]])))
    return two | {"log_scales": np.log(np.float32([[0.001] * 3, [0.1, 0.05, 0.05]]))}


def gradients_of(model: Model, value: float) -> Parameters:
    """Gradients that have one value everywhere."""
    return Parameters(**{name: np.full_like(values, value) for name, values in model.parameters.items()})


@pytest.mark.parametrize(
    ("most", "widths"), [(1000, [0.001, 0.001, 0.0625, 0.0625]), (3, [0.001, 0.0625, 0.0625])]
)
def test_small_gaussians_are_cloned_and_large_ones_split_by_gradient_up_to_the_cap(most, widths):
    model = Model(two_gaussians())
    settings = GaussiansSettings(densify_gradient=0.5).model_copy(update={"max_gaussians": most})
    model.total, model.seen = np.array([1.0, 2.0]), np.ones(2, np.int32)
    densify(model, settings, 1.0, np.random.default_rng(0))
    # the small one, its clone if there is room, and the two halves of the large one: 0.1 / 1.6
    np.testing.assert_allclose(np.exp(model.parameters["log_scales"][:, 0]), widths, rtol=1e-5)
    np.testing.assert_array_equal(model.parameters["means"][:-2], 0)
    assert not np.array_equal(model.parameters["means"][-2], model.parameters["means"][-1])


def test_transparent_and_huge_gaussians_are_pruned_and_opacity_is_reset():
    model = Model(two_gaussians())
    model.parameters["opacity_logits"][0] = -6  # opacity 0.0025 < 0.005
    prune(model, GaussiansSettings(), extent=1.0)
    assert len(model) == 1
    reset_opacities(model)
    assert 1 / (1 + np.exp(-model.parameters["opacity_logits"][0])) == pytest.approx(0.01, rel=1e-5)
    prune(model, GaussiansSettings(), extent=0.1)  # largest axis 0.1 >= 0.5 x 0.1
    assert len(model) == 0


def test_screen_gradient_is_in_units_of_half_the_image():
    model = Model(two_gaussians())
    for drawn in ([True, True], [True, False]):
        model.add_screen_gradients(np.float32([[3e-3, 2e-3], [0, 0]]), np.array(drawn), (40, 20))
    # x times 10, y times 20: (0.03, 0.04) has length 0.05 in both steps
    assert model.screen_gradients() == pytest.approx([0.05, 0], rel=1e-6)
    assert model.seen.tolist() == [2, 1]


def test_first_adam_step_moves_by_the_rate_against_the_sign():
    model = Model(two_gaussians())
    before = {name: values.copy() for name, values in model.parameters.items()}
    settings = GaussiansSettings(scales_rate=0.01, sh_rate=2.5e-3)
    model.descend(gradients_of(model, 1.0), step_sizes(settings, 3.2e-4))
    np.testing.assert_allclose(before["means"] - model.parameters["means"], 3.2e-4, rtol=1e-3)
    np.testing.assert_allclose(before["log_scales"] - model.parameters["log_scales"], 0.01, rtol=1e-3)
    np.testing.assert_allclose(before["sh"] - model.parameters["sh"], 2.5e-3, rtol=1e-3)


MCMC = GaussiansSettings(strategy="mcmc")
NO_GROWTH = MCMC.model_copy(update={"mcmc_growth": 0.0})


def row_of_gaussians(opacity: list[float], scale: float = 0.2) -> dict[str, np.ndarray]:
    n = len(opacity)
    row = vars(round_gaussians(np.arange(n)[:, None] * np.eye(1, 3), log_scale=math.log(scale)))
    sh = np.arange(3 * n, dtype=np.float32).reshape(n, 1, 3)
    return row | {"opacity_logits": logit(np.array(opacity)).astype(np.float32), "sh": sh}


@pytest.mark.parametrize(("opacity", "number"), [(0.3, 1), (0.75, 2), (0.8, 5), (0.99, 20), (0.999, 51)])
def test_coincident_gaussians_cover_what_one_covered(opacity, number):
    new = 1 - (1 - opacity) ** (1 / number)  # 0.5 for two of 0.75
    assert shared_opacity(np.array([opacity]), np.array([number]))[0] == pytest.approx(new, rel=1e-12)
    found = scale_factor(np.array([opacity]), np.array([new]), np.array([number]))[0]
    # the profile keeps its integral
    x = np.linspace(-12, 12, 24001)
    one = opacity * np.exp(-(x**2) / 2)
    many = 1 - (1 - new * np.exp(-((x / found) ** 2) / 2)) ** number
    assert np.trapezoid(many, x) == pytest.approx(np.trapezoid(one, x), rel=1e-6)


def test_dead_gaussians_move_onto_live_ones_and_moments_are_reset():
    model = Model(row_of_gaussians([0.9, 0.004, 0.5, 0.001]))
    for table in (model.first, model.second):
        for values in table.values():
            values[:] = 1
    relocate_and_grow(model, NO_GROWTH, np.random.default_rng(1))
    assert len(model) == 4
    assert set(model.parameters["means"][:, 0]) <= {0.0, 2.0}
    moved = model.parameters["means"][[1, 3], 0]
    for source in (0, 2):
        members = np.flatnonzero(model.parameters["means"][:, 0] == source)
        opacity, number = [0.9, None, 0.5][source], len(members)
        assert 1 - np.prod(1 - opacities(model)[members]) == pytest.approx(opacity, rel=1e-4)
        shared = shared_opacity(np.array([opacity]), np.array([number]))
        scale = 0.2 * scale_factor(np.array([opacity]), shared, np.array([number])).item()
        np.testing.assert_allclose(np.exp(model.parameters["log_scales"][members]), scale, rtol=1e-4)
        touched = source in moved
        assert (model.first["means"][members] == (0 if touched else 1)).all()


@pytest.mark.parametrize(("min_opacity", "opacity"), [(0.005, 0.1), (0.003, 0.1), (0.1, 0.6), (0.5, 0.9)])
def test_gaussians_that_share_a_place_stay_alive(min_opacity, opacity):
    # an equal share for 51 would be 0.002, 0.002, 0.018 or 0.044: below each threshold
    model = Model(row_of_gaussians([opacity] + [min_opacity / 2] * 200))
    settings = NO_GROWTH.model_copy(update={"min_opacity": min_opacity})
    relocate_and_grow(model, settings, np.random.default_rng(0))
    assert (opacities(model) > min_opacity).all()
    np.testing.assert_allclose(opacities(model), min_opacity, rtol=1e-5)
    before = {name: values.copy() for name, values in model.parameters.items()}
    relocate_and_grow(model, settings, np.random.default_rng(1))
    for name, values in before.items():
        np.testing.assert_array_equal(model.parameters[name], values)


def test_growth_is_a_share_and_stops_at_the_cap():
    model = Model(row_of_gaussians([0.5] * 40))
    settings = MCMC.model_copy(update={"mcmc_growth": 0.05, "max_gaussians": 43})
    relocate_and_grow(model, settings, np.random.default_rng(0))
    assert len(model) == 42  # 5 % of 40
    for _ in range(2):
        relocate_and_grow(model, settings, np.random.default_rng(0))
        assert len(model) == 43
    # each place keeps its opacity, however many Gaussians share it
    for place in range(40):
        members = model.parameters["means"][:, 0] == place
        assert 1 - np.prod(1 - opacities(model)[members]) == pytest.approx(0.5, rel=1e-4)


def test_places_are_drawn_by_their_opacity():
    model = Model(row_of_gaussians([0.8, 0.2] + [0.0001] * 4000))
    relocate_and_grow(model, NO_GROWTH, np.random.default_rng(0))
    share = (model.parameters["means"][2:, 0] == 0).mean()
    assert share == pytest.approx(0.8, abs=0.02)  # standard error 0.006


def test_noise_is_normal_numbers_times_the_covariance_and_spares_opaque_gaussians():
    opacity = np.array([0.004, 0.005, 0.015] * 10 + [0.99] * 2)
    parameters = row_of_gaussians(opacity.tolist())
    generator = np.random.default_rng(2)
    parameters["log_scales"] = np.log(generator.uniform(0.001, 0.02, (32, 3))).astype(np.float32)
    parameters["quats"] = (3 * generator.normal(size=(32, 4))).astype(np.float32)
    model = Model(parameters | {"means": parameters["means"].copy()})
    model.add_noise(MCMC, 1e-4, 2.0, np.random.default_rng(0))
    normal = np.random.default_rng(0).standard_normal((32, 3), dtype=np.float32)
    turns = Rotation.from_quat(np.roll(parameters["quats"], -1, axis=1)).as_matrix()
    root = turns * np.exp(parameters["log_scales"].astype(float))[:, None]
    gate = expit(-100 * (opacity - 0.005))[:, None]
    # lengths in units of the extent 2, and back
    expected = 5e5 * 1e-4 * gate * np.einsum("nij,nkj,nk->ni", root, root, normal) / 2
    # means lie up to 30 from 0, where float32 steps by 2e-6
    np.testing.assert_allclose(model.parameters["means"] - parameters["means"], expected, atol=2e-6)
    np.testing.assert_array_equal(model.parameters["means"][30:], parameters["means"][30:])


def test_regularisers_add_the_gradient_of_mean_opacity_and_mean_scale():
    model = Model(row_of_gaussians([0.5, 0.2], scale=0.3))
    gradients = gradients_of(model, 0.0)
    settings = MCMC.model_copy(update={"mcmc_opacity_weight": 0.1, "mcmc_scale_weight": 0.6})
    model.add_regularisers(gradients, settings, extent=2.0)
    # 0.1 / 2 x o (1 - o); 0.6 / (3 x 2) x 0.3 / 2
    np.testing.assert_allclose(gradients.opacity_logits, [0.05 * 0.25, 0.05 * 0.16], rtol=1e-5)
    np.testing.assert_allclose(gradients.log_scales, 0.015, rtol=1e-5)
