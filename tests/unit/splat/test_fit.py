"""The fit on a scene of three Gaussians: it improves, it resumes, and threads do not matter."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import SceneError
from hilsplat.base.images import write_png
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat import fit
from hilsplat.splat.densify import ScreenGradients, densify, prune, reset_opacities
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.optimise import Adam
from hilsplat.splat.photometric import psnr
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.rasterise.cpu import Gradients

SETTINGS = GaussiansSettings(
    iterations=60, densify_every=10, checkpoint_every=25, sh_degree=1, max_gaussians=400
)


def ring(number: int, size: int) -> Cameras:
    """Cameras on a circle of radius 3 that look at the origin."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, number, endpoint=False):
        centre = 3 * np.array([np.cos(angle), np.sin(angle), 0.4])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        poses.append(pose)
    K = np.array([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1.0]])
    names = tuple(f"{view:03d}.png" for view in range(number))
    return Cameras(names, np.stack(poses), np.tile(K, (number, 1, 1)), np.full((number, 2), size, np.int32))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Three coloured Gaussians seen from nine views, two of them held out; eight points."""
    folder = tmp_path_factory.mktemp("world") / "scene"
    truth = Gaussians(
        torch.tensor([[0.4, 0, 0], [-0.4, 0.2, 0.1], [0, -0.4, 0.3]]),
        torch.tensor([[0.3, 0.2, 0.2], [0.15, 0.3, 0.2], [0.2, 0.2, 0.35]]).log(),
        torch.tensor([[1.0, 0.2, 0, 0], [1, 0, 0.3, 0], [1, 0, 0, 0]]),
        torch.tensor([3.0, 3.0, 3.0]),
        torch.tensor([[[1.5, -1, -1]], [[-1, 1.5, -1]], [[-1, -1, 1.5]]]),
    )
    cameras = ring(9, 48)
    for name in cameras.names:
        color = render(truth, cameras[name]).color.clamp(0, 1).numpy()
        write_png(folder / "images" / name, np.round(color * 255).astype(np.uint8))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 3)).astype(np.float32)
    split = {name: "test" if row % 4 == 3 else "train" for row, name in enumerate(cameras.names)}
    made = Scene(
        folder, "toy/three", "arbitrary", cameras, split, points, np.full((8, 3), 128, np.uint8), np.eye(4)
    )
    made.save()
    return made


def mean_psnr(scene: Scene, gaussians: Gaussians) -> float:
    values = []
    for name in scene.views("test"):
        shown = render(gaussians, scene.cameras[name]).color.clamp(0, 1).numpy()
        values.append(psnr(shown, scene.image(name).astype(np.float32) / 255))
    return float(np.mean(values))


def test_fit_improves_held_out_views(scene):
    first, _ = fit.fit_gaussians(scene, SETTINGS.model_copy(update={"iterations": 1}), seed=0)
    last, curve = fit.fit_gaussians(scene, SETTINGS.model_copy(update={"iterations": 200}), seed=0)
    assert mean_psnr(scene, last) > mean_psnr(scene, first) + 5
    assert len(last) <= SETTINGS.max_gaussians
    assert curve[-1, 0] == 200


def outputs(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_stage_writes_the_same_bytes_on_any_threads_and_after_a_stop(scene, tmp_path, monkeypatch):
    def stage(name: str, threads: int) -> dict[str, bytes]:
        out = tmp_path / name
        fit.run_gaussians(
            scene.folder, out / "g.ply", out / "report", tmp_path / "cache", SETTINGS, 3, threads
        )
        return outputs(out)

    undisturbed = stage("one", threads=1)
    assert undisturbed == stage("two", threads=2)
    assert set(undisturbed) == {
        *("g.ply", "report.json", "curves.png", "test_views.png", "flyaround.png", "index.json")
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


def test_another_fits_checkpoint_is_not_used(scene, tmp_path):
    adam = Adam.start(
        fit.first_gaussians(scene, [scene.cameras["000.png"]], SETTINGS, np.random.default_rng(0))
    )
    state = fit.FitState(adam, ScreenGradients.start(len(adam)), np.random.default_rng(0))
    state.save(tmp_path / "c.npz", "this")
    assert fit.FitState.load(tmp_path / "c.npz", "other") is None
    assert len(fit.FitState.load(tmp_path / "c.npz", "this").adam) == len(adam)


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
    settings = GaussiansSettings(densify_gradient=0.5, max_gaussians=100).model_copy(
        update={"max_gaussians": 3}
    )
    gradients = ScreenGradients(np.array([1.0, 2.0]), np.ones(2, np.int32))
    densify(adam, gradients, settings, 1.0, np.random.default_rng(0))
    assert len(adam) == 3
    np.testing.assert_allclose(
        np.exp(adam.parameters["log_scales"][:, 0]), [0.001, 0.0625, 0.0625], rtol=1e-5
    )


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
    gradients = Gradients(
        **ones, features=np.zeros((2, 0), np.float32), means_px=np.zeros((2, 2), np.float32)
    )
    adam.step(gradients, progress=0.0, extent=2.0, threads=1)
    np.testing.assert_allclose(before["means"] - adam.parameters["means"], 3.2e-4, rtol=1e-3)
    np.testing.assert_allclose(before["sh"] - adam.parameters["sh"], 2.5e-3, rtol=1e-3)
