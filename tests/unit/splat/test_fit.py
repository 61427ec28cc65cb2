"""The fit on a scene of three Gaussians: it improves, it resumes, and threads do not matter."""

from dataclasses import replace

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_json
from hilsplat.base.errors import SceneError
from hilsplat.settings import GaussiansSettings
from hilsplat.splat import fit
from hilsplat.splat.densify import ScreenGradients, densify, prune, reset_opacities
from hilsplat.splat.gaussians import morton_order
from hilsplat.splat.initial import RANDOM_POINTS, first_gaussians
from hilsplat.splat.optimise import Adam, means_rate
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.cpu import Gradients
from tests.unit.splat.three_gaussians_world import mean_psnr

SETTINGS = GaussiansSettings(
    iterations=60, densify_every=10, checkpoint_every=25, sh_degree=1, max_gaussians=400
)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_fit_improves_held_out_views(scene, strategy):
    settings = SETTINGS.model_copy(update={"strategy": strategy})
    first, _ = fit.fit_gaussians(scene, settings.model_copy(update={"iterations": 1}), seed=0)
    last, curve = fit.fit_gaussians(scene, settings.model_copy(update={"iterations": 200}), seed=0)
    assert mean_psnr(scene, last) > mean_psnr(scene, first) + 5
    assert len(last) <= SETTINGS.max_gaussians
    assert curve[-1, 0] == 200
    assert np.array_equal(morton_order(last.means), np.arange(len(last)))


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_stage_writes_the_same_bytes_on_any_threads_and_after_a_stop(scene, tmp_path, monkeypatch, strategy):
    settings = SETTINGS.model_copy(update={"strategy": strategy, "background": "random"})

    def stage(name: str, threads: int) -> dict[str, bytes]:
        out = tmp_path / name
        fit.run_gaussians(
            scene.folder, out / "g.ply", out / "report", tmp_path / "cache", settings, 3, threads
        )
        return {path.name: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    undisturbed = stage("one", threads=1)
    assert undisturbed == stage("two", threads=2)
    assert set(undisturbed) == {
        *("g.ply", "g.json", "report.json", "curves.png", "test_views.png"),
        *("flyaround.png", "flyaround.mp4", "index.json"),
    }
    assert not list((tmp_path / "cache").rglob("*.npz"))

    step = fit.fit_step

    def stops_at_40(state, *arguments):
        if state.step == 40:
            raise KeyboardInterrupt
        step(state, *arguments)

    monkeypatch.setattr(fit, "fit_step", stops_at_40)
    with pytest.raises(KeyboardInterrupt):
        stage("stopped", threads=1)
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 1
    steps = []
    monkeypatch.setattr(fit, "fit_step", lambda state, *rest: (steps.append(state.step), step(state, *rest)))
    assert stage("resumed", threads=1) == undisturbed
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


def test_another_fits_checkpoint_is_not_used(scene, tmp_path):
    adam = Adam.start(first_gaussians(scene, [scene.cameras["000.png"]], SETTINGS, np.random.default_rng(0)))
    state = fit.FitState(adam, ScreenGradients.start(len(adam)), np.random.default_rng(0))
    state.save(tmp_path / "c.npz", "this")
    assert fit.FitState.load(tmp_path / "c.npz", "other") is None
    assert len(fit.FitState.load(tmp_path / "c.npz", "this").adam) == len(adam)


def test_a_fit_does_not_resume_on_another_device(scene, tmp_path, monkeypatch):
    draw, step, device, steps = fit.draw, fit.fit_step, "cuda", []

    def stage(name: str) -> bytes:
        out = tmp_path / name
        fit.run_gaussians(scene.folder, out, tmp_path / "report", tmp_path / "cache", SETTINGS, 3, 1)
        return out.read_bytes()

    def counted(state, *rest):
        if device == "cuda" and state.step == 40:
            raise KeyboardInterrupt
        steps.append(state.step)
        step(state, *rest)

    def drawn(*arguments, device: str, **more):  # the second device draws as the CPU does
        return draw(*arguments, **more, device="cpu")

    on_the_cpu = stage("whole.ply")
    monkeypatch.setattr(fit, "choose_device", lambda requested: device if requested == "auto" else requested)
    monkeypatch.setattr(fit, "draw", drawn)
    monkeypatch.setattr(fit, "fit_step", counted)
    with pytest.raises(KeyboardInterrupt):
        stage("stopped.ply")
    assert len(list((tmp_path / "cache").rglob("*.npz"))) == 1
    device, steps[:] = "cpu", []
    assert stage("other.ply") == on_the_cpu
    assert steps[0] == 0


def test_random_start_holds_as_many_points_as_asked_in_sight_of_cameras(scene):
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
def test_frozen_gaussians_stay_the_points(scene, strategy):
    points = np.random.default_rng(0).normal(0, 0.3, (150, 3)).astype(np.float32)
    bare = replace(scene, points_xyz=points, points_rgb=np.full((150, 3), 128, np.uint8))
    few = {"initial": "frozen", "max_gaussians": 100, "strategy": strategy, "opacity_reset_every": 20}
    settings = SETTINGS.model_copy(update=few)
    gaussians, curve = fit.fit_gaussians(bare, settings, seed=0)
    assert np.array_equal(gaussians.means, points)
    assert curve[-1, 2] > curve[0, 2]  # colours, sizes and opacities are fitted all the same
    assert len(set(gaussians.opacities.round(3))) > 50


def test_frozen_points_must_be_there(scene):
    broken = scene.points_xyz.copy()
    broken[0] = np.nan
    settings = SETTINGS.model_copy(update={"initial": "frozen"})
    for xyz in (broken, broken[:0]):
        bare = replace(scene, points_xyz=xyz, points_rgb=scene.points_rgb[: len(xyz)])
        with pytest.raises(SceneError, match=r"gaussians\.initial: frozen"):
            fit.fit_gaussians(bare, settings, seed=0)


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
    assert means_rate(settings, 0.0) == pytest.approx(1e-2)
    assert means_rate(settings, 0.5) == pytest.approx(1e-3)
    assert means_rate(settings, 1.0) == pytest.approx(1e-4)


def test_scene_without_training_views_is_refused(scene):
    held_out = replace(scene, split=dict.fromkeys(scene.cameras.names, "test"))
    with pytest.raises(SceneError, match="no training view"):
        fit.fit_gaussians(held_out, SETTINGS, seed=0)


def two_gaussians() -> dict[str, np.ndarray]:
    """A small one (largest axis 0.001) and a large one (0.1)."""
    return {
        "means": np.float32([[0, 0, 0], [1, 0, 0]]),
        "log_scales": np.log(np.float32([[0.001] * 3, [0.1, 0.05, 0.05]])),
        "quats": np.float32([[1, 0, 0, 0]] * 2),
        "opacity_logits": np.float32([0, 1]),
        "sh": np.zeros((2, 1, 3), np.float32),
    }


def test_small_is_cloned_and_large_is_split():
    adam = Adam.start(two_gaussians())
    settings = GaussiansSettings(densify_gradient=0.5)
    densify(adam, ScreenGradients(np.ones(2), np.ones(2, np.int32)), settings, 1.0, np.random.default_rng(0))
    # the small one, its clone, and two halves of the large one
    assert len(adam) == 4
    np.testing.assert_array_equal(adam.parameters["means"][:2], 0)
    np.testing.assert_allclose(np.exp(adam.parameters["log_scales"][2:, 0]), 0.1 / 1.6, rtol=1e-5)
    assert not np.array_equal(adam.parameters["means"][2], adam.parameters["means"][3])


def test_the_cap_takes_the_largest_gradient_first():
    adam = Adam.start(two_gaussians())
    settings = GaussiansSettings(densify_gradient=0.5).model_copy(update={"max_gaussians": 3})
    gradients = ScreenGradients(np.array([1.0, 2.0]), np.ones(2, np.int32))
    densify(adam, gradients, settings, 1.0, np.random.default_rng(0))
    assert len(adam) == 3
    widths = np.exp(adam.parameters["log_scales"][:, 0])
    np.testing.assert_allclose(widths, [0.001, 0.0625, 0.0625], rtol=1e-5)


def test_transparent_and_huge_are_pruned_and_opacity_is_reset():
    adam = Adam.start(two_gaussians())
    adam.parameters["opacity_logits"][0] = -6  # opacity 0.0025 < 0.005
    prune(adam, GaussiansSettings(), extent=1.0)
    assert len(adam) == 1
    reset_opacities(adam)
    assert 1 / (1 + np.exp(-adam.parameters["opacity_logits"][0])) == pytest.approx(0.01, rel=1e-5)
    prune(adam, GaussiansSettings(), extent=0.1)  # largest axis 0.1 >= 0.5 x 0.1
    assert len(adam) == 0


def test_screen_gradient_is_in_units_of_half_the_image():
    gradients = ScreenGradients.start(1)
    for _ in range(2):
        gradients.add(np.float32([[3e-3, 2e-3]]), np.array([True]), (40, 20))
    # x times 10, y times 20: (0.03, 0.04) has length 0.05, the same in both steps
    assert gradients.mean()[0] == pytest.approx(0.05, rel=1e-6)


def test_first_adam_step_moves_by_the_rate_against_the_sign():
    adam = Adam.start(two_gaussians())
    before = {name: values.copy() for name, values in adam.parameters.items()}
    ones = {name: np.ones_like(values) for name, values in before.items()}
    features, means_px = np.zeros((2, 0), np.float32), np.zeros((2, 2), np.float32)
    gradients = Gradients(**ones, features=features, means_px=means_px)
    adam.step(gradients, GaussiansSettings(scales_rate=0.01, sh_rate=2.5e-3), rate_of_means=3.2e-4, threads=1)
    np.testing.assert_allclose(before["means"] - adam.parameters["means"], 3.2e-4, rtol=1e-3)
    np.testing.assert_allclose(before["log_scales"] - adam.parameters["log_scales"], 0.01, rtol=1e-3)
    np.testing.assert_allclose(before["sh"] - adam.parameters["sh"], 2.5e-3, rtol=1e-3)
