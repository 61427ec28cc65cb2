"""Base 3D Gaussian Splatting fit (Kerbl et al. 2023) on the CPU; the geometry of everything after."""

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from scipy.spatial import cKDTree

from hilsplat.base.artifacts import read_npz, sha256_of_json, sha256_of_path, write_npz
from hilsplat.base.code_hash import code_hash
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.images import to_float
from hilsplat.base.progress import stage_log, track
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.densify import ScreenGradients, densify, prune, reset_opacities
from hilsplat.splat.fit_report import write_report
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.optimise import FIELDS, Adam
from hilsplat.splat.photometric import photometric_loss
from hilsplat.splat.ply import save_ply
from hilsplat.splat.rasterise.cpu import blend_forward, blend_gradients, project_gaussians

logger = logging.getLogger(__name__)

SH_0 = 0.28209479177387814
FIRST_OPACITY = 0.1  # 3DGS
MIN_POINTS = 200
"""With fewer sparse points, random points between the cameras make up the difference."""
CURVE_EVERY = 20
"""Steps between two points of the curves."""


@dataclass(frozen=True)
class TrainingView:
    """One view at the size it is fitted at."""

    name: str
    camera: Camera
    image: UInt8[np.ndarray, "H W 3"]


def load_views(scene: Scene, split: str, image_scale: float) -> list[TrainingView]:
    """Images and cameras of a split, shrunk by `image_scale` (box filter)."""
    views = []
    for name in scene.views(split):
        image, camera = scene.image(name), scene.cameras[name]
        if image_scale < 1:
            size_hw = tuple(max(1, round(side * image_scale)) for side in image.shape[:2])
            shrunk = Image.fromarray(image).resize(size_hw[::-1], Image.Resampling.BOX)
            image, camera = np.asarray(shrunk), camera.scaled(size_hw)
        views.append(TrainingView(name, camera, image))
    return views


def camera_extent(cameras: list[Camera]) -> float:
    """1.1 times the largest distance of a camera from their common centre (3DGS); scene units."""
    centres = np.stack([camera.centre for camera in cameras])
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    return float(1.1 * radius) if radius > 0 else 1.0


def first_gaussians(
    scene: Scene, cameras: list[Camera], settings: GaussiansSettings, generator: np.random.Generator
) -> dict[str, np.ndarray]:
    """Round Gaussians at the sparse points, as wide as the mean distance to their 3 nearest (3DGS).

    Scenes with fewer than MIN_POINTS points get random grey ones in front of random cameras.
    """
    xyz, rgb = scene.points_xyz.astype(np.float64), to_float(scene.points_rgb)
    finite = np.isfinite(xyz).all(axis=1)
    xyz, rgb = xyz[finite], rgb[finite]
    if len(xyz) > settings.max_gaussians:
        rows = np.sort(generator.choice(len(xyz), settings.max_gaussians, replace=False))
        xyz, rgb = xyz[rows], rgb[rows]
    if len(xyz) < MIN_POINTS:
        logger.warning("%s has %d sparse points; random points are added", scene.name, len(xyz))
        number = min(2000, settings.max_gaussians - len(xyz))
        more = _random_points(cameras, xyz, number, generator)
        xyz, rgb = np.concatenate([xyz, more]), np.concatenate([rgb, np.full((number, 3), 0.5, np.float32)])
    n = len(xyz)
    distances = cKDTree(xyz).query(xyz, k=min(4, n))[0].reshape(n, -1)[:, 1:]
    spacing = distances.mean(axis=1) if distances.shape[1] else np.full(n, 0.1)
    # points on one spot would get no width; points far from all others would fill the view
    extent = camera_extent(cameras)
    spacing = np.clip(spacing, 1e-4 * extent, 0.1 * extent)
    sh = np.zeros((n, (settings.sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / SH_0
    return {
        "means": xyz.astype(np.float32),
        "log_scales": np.repeat(np.log(spacing)[:, None], 3, axis=1).astype(np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        "opacity_logits": np.full(n, np.log(FIRST_OPACITY / (1 - FIRST_OPACITY)), np.float32),
        "sh": sh,
    }


def _random_points(
    cameras: list[Camera], known: np.ndarray, number: int, generator: np.random.Generator
) -> np.ndarray:
    """Points seen by random cameras, at depths about the known points' or the cameras' spread."""
    extent = camera_extent(cameras)
    depths = []
    for camera in cameras:
        z = known @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        depths += z[z > 0].tolist()
    near, far = np.quantile(depths, [0.05, 0.95]) if depths else (0.3 * extent, 2.0 * extent)
    out = np.empty((number, 3))
    for row in range(number):
        camera = cameras[generator.integers(len(cameras))]
        z = generator.uniform(near, far + 1e-6)
        pixel = generator.uniform(size=2) * camera.size_hw[::-1]
        ray = np.linalg.solve(camera.K, [pixel[0], pixel[1], 1.0])
        out[row] = camera.cam_from_world[:3, :3].T @ (z * ray - camera.cam_from_world[:3, 3])
    return out


@dataclass
class FitState:
    """Everything that the next step depends on, so that a stopped fit goes on as if it had not stopped.

    Attributes:
        adam: parameters and moments.
        gradients: screen gradients since the last densification.
        generator: source of view order, splits and random backgrounds.
        order: views still to come in this round, as indices.
        step: steps done.
        curve: rows of (step, loss, training PSNR in dB, number of Gaussians).
    """

    adam: Adam
    gradients: ScreenGradients
    generator: np.random.Generator
    order: list[int] = field(default_factory=list)
    step: int = 0
    curve: list[tuple[float, float, float, float]] = field(default_factory=list)

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint."""
        arrays = {
            f"{table}_{name}": getattr(self.adam, table)[name]
            for table in ("parameters", "first", "second")
            for name in FIELDS
        }
        write_npz(
            path,
            key=np.array(key),
            counts=np.array([self.step, self.adam.steps]),
            order=np.array(self.order, dtype=np.int64),
            generator=np.array(json.dumps(self.generator.bit_generator.state)),
            gradient_total=self.gradients.total,
            gradient_seen=self.gradients.seen,
            curve=np.array(self.curve, dtype=np.float64).reshape(-1, 4),
            **arrays,
        )

    @staticmethod
    def load(path: Path, key: str) -> "FitState | None":
        """Read a checkpoint of this very fit; None where there is none, or only another fit's."""
        if not path.is_file():
            return None
        try:
            arrays = read_npz(path)
        except ArtifactError as error:
            logger.warning("checkpoint is passed over, the fit starts anew: %s", error)
            return None
        if arrays["key"].item() != key:
            logger.info("checkpoint %s belongs to other inputs; the fit starts anew", path)
            return None
        tables = [
            {name: arrays[f"{table}_{name}"] for name in FIELDS}
            for table in ("parameters", "first", "second")
        ]
        generator = np.random.default_rng()
        generator.bit_generator.state = json.loads(arrays["generator"].item())
        step, adam_steps = (int(count) for count in arrays["counts"])
        return FitState(
            Adam(*tables, steps=adam_steps),
            ScreenGradients(arrays["gradient_total"], arrays["gradient_seen"]),
            generator,
            arrays["order"].tolist(),
            step,
            [tuple(row) for row in arrays["curve"].tolist()],
        )


def fit_step(
    state: FitState, views: list[TrainingView], settings: GaussiansSettings, extent: float, threads: int
) -> None:
    """One view: render, compare, step; then density control where it is due."""
    if not state.order:
        state.order = state.generator.permutation(len(views)).tolist()
    view = views[state.order.pop()]
    progress = state.step / settings.iterations
    # 3DGS adds a degree every 1000 of 30 000 steps; short fits get the whole colour by a third
    degree = min(settings.sh_degree, int(progress * 10))
    behind = {"black": np.zeros(3), "white": np.ones(3)}.get(settings.background)
    if behind is None:
        behind = state.generator.uniform(size=3)
    behind = behind.astype(np.float32)

    parameters = state.adam.as_parameters()
    projected = project_gaussians(parameters, view.camera, degree, threads)
    image, alpha = blend_forward(projected, projected.colours, threads)
    shown = image + (1 - alpha)[..., None] * behind
    target = to_float(view.image)
    loss, grad = photometric_loss(shown, target, ssim_weight=settings.ssim_weight, threads=threads)
    gradients = blend_gradients(
        parameters, projected, projected.colours, image, alpha, grad, -(grad @ behind), threads
    )
    densify_until = int(settings.densify_until * settings.iterations)
    if state.step < densify_until:
        drawn = projected.box[:, 1] >= projected.box[:, 0]
        state.gradients.add(gradients.means_px, drawn, view.camera.size_hw)
    state.adam.step(gradients, progress, extent, threads)
    state.step += 1
    if state.step % CURVE_EVERY == 0:
        error = float(np.square(shown - target).mean(dtype=np.float64))
        state.curve.append((state.step, loss, -10 * np.log10(max(error, 1e-12)), len(state.adam)))

    if settings.densify_from * settings.iterations <= state.step <= densify_until:
        if state.step % settings.densify_every == 0:
            densify(state.adam, state.gradients, settings, extent, state.generator)
            prune(state.adam, settings, extent)
            state.gradients = ScreenGradients.start(len(state.adam))
        if state.step % settings.opacity_reset_every == 0 and state.step < densify_until:
            reset_opacities(state.adam)


def fit_gaussians(
    scene: Scene,
    settings: GaussiansSettings,
    *,
    seed: int,
    threads: int = 1,
    checkpoint: Path | None = None,
    key: str = "",
) -> tuple[Gaussians, np.ndarray]:
    """Fit Gaussians to the training views of a scene.

    Args:
        seed: fixes the view order, splits and random points; the result is the same bytes for any
            number of threads, and for a fit that was stopped and went on.
        checkpoint: file to keep the state in every `checkpoint_every` steps and to go on from;
            removed at the end.
        key: digest of everything the fit depends on; another fit's checkpoint is not used.

    Returns:
        The Gaussians, and the curve: rows of (step, loss, training PSNR, number of Gaussians).

    Raises:
        SceneError: there is no training view, or nothing is left to draw.
    """
    views = load_views(scene, "train", settings.image_scale)
    if not views:
        raise SceneError(f"{scene.name} has no training view", fix="hold fewer views out: poses.test_every")
    cameras = [view.camera for view in views]
    extent = camera_extent(cameras)
    state = FitState.load(checkpoint, key) if checkpoint else None
    if state is None:
        generator = np.random.default_rng(seed)
        adam = Adam.start(first_gaussians(scene, cameras, settings, generator))
        state = FitState(adam, ScreenGradients.start(len(adam)), generator)
    else:
        logger.info("going on from the checkpoint at step %d", state.step)
    for _ in track(range(state.step, settings.iterations), "fit steps"):
        fit_step(state, views, settings, extent, threads)
        if len(state.adam) == 0:
            raise SceneError(
                f"all Gaussians of {scene.name} became transparent",
                fix="check the poses (registration.png), or lower gaussians.min_opacity",
            )
        if checkpoint and state.step % settings.checkpoint_every == 0 and state.step < settings.iterations:
            state.save(checkpoint, key)
    prune(state.adam, settings, extent)
    tensors = {name: torch.from_numpy(values) for name, values in state.adam.parameters.items()}
    if checkpoint:
        checkpoint.unlink(missing_ok=True)
    return Gaussians(**tensors), np.array(state.curve, dtype=np.float64).reshape(-1, 4)


def run_gaussians(
    scene_folder: Path,
    out_ply: Path,
    out_report: Path,
    cache: Path,
    settings: GaussiansSettings,
    seed: int,
    threads: int,
) -> None:
    """Stage: fit, write `gaussians.ply` and the report folder (test PSNR/SSIM, curves, pictures)."""
    scene = Scene.load(scene_folder)
    key = sha256_of_json(
        [
            settings.model_dump(mode="json"),
            seed,
            sha256_of_path(scene_folder),
            code_hash("hilsplat.splat.fit"),
        ]
    )
    checkpoint = Path(cache) / "gaussians" / f"{key[:16]}.npz"
    with stage_log("gaussians", scene.name) as counts:
        gaussians, curve = fit_gaussians(
            scene, settings, seed=seed, threads=threads, checkpoint=checkpoint, key=key
        )
        views = load_views(scene, "test", settings.image_scale)
        split = "test" if views else "train"
        views = views or load_views(scene, "train", settings.image_scale)
        targets = {view.name: (view.camera, view.image) for view in views}
        path = [scene.cameras[name] for name in scene.views("train")]
        report = write_report(out_report, gaussians, targets, split, path, curve, settings, threads)
        save_ply(out_ply, gaussians)
        counts.update(
            gaussians=len(gaussians),
            psnr=f"{report['psnr_db']:.2f} dB",
            ssim=f"{report['ssim']:.3f} ({split})",
        )
