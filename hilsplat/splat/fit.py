"""Base fit of 3D Gaussian Splatting (Kerbl et al. 2023), whose geometry later stages use, and its report."""

import json
import logging
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from cpusplat.photometric import psnr, ssim
from hilsplat.base.artifacts import read_npz, write_arrays, write_index, write_json
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.code import code_digest
from hilsplat.base.errors import ArtifactError, SceneError
from hilsplat.base.images import to_float, write_png
from hilsplat.base.lineage import sha256_of_json, sha256_of_path
from hilsplat.base.progress import stage_log, track
from hilsplat.base.removal import delete, tag
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.coordinates import import_gaussians, write_coordinates
from hilsplat.splat.densify import control_density, prune
from hilsplat.splat.flyaround import contact_sheet, write_flyaround
from hilsplat.splat.gaussians import Gaussians, morton_order
from hilsplat.splat.initial import TrainingView, camera_extent, first_gaussians, load_views
from hilsplat.splat.model import Model, StepOptions, means_rate, model_on
from hilsplat.splat.ply import save_ply
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.rasterise.device import Device, choose_device, explained_memory, require_card_memory
from hilsplat.splat.steps import fit_steps

logger = logging.getLogger(__name__)

CURVE_EVERY = 20  # number of steps between two points on the training curve
MIN_SIDE_PX = 64  # minimum length of a downscaled image's shorter side
MAX_SHOWN = 8  # maximum number of views on the contact sheet of test views
ERROR_GAIN = 4  # factor by which displayed errors are multiplied
MAX_PSNR_DB = 120.0  # PSNR of a view without error, because JSON has no infinity

MEMORY_USER = "the fit of the Gaussians"
MEMORY_FIX = (
    "lower gaussians.max_gaussians or gaussians.image_scale, end other programs that use the card, "
    "or set gaussians.device: cpu"
)


@dataclass
class FitState:
    """State from which a fit resumes exactly."""

    model: Model  # its `steps` are the completed steps of the fit
    generator: np.random.Generator  # for view order, splits, backgrounds and noise
    order: list[int] = field(default_factory=list)  # indices of the remaining views in this epoch
    curve: list[list[float]] = field(default_factory=list)  # step, loss, training PSNR (dB), Gaussians

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        tag(path.parent)
        arrays = {
            "order": np.array(self.order, dtype=np.int64),
            "generator": np.array(json.dumps(self.generator.bit_generator.state)),
            "curve": np.array(self.curve).reshape(-1, 4),
            **self.model.state(),
        }
        write_arrays(path, arrays, compressed=False)  # compression would take longer than a hundred steps

    @staticmethod
    def load(path: Path, model: type[Model], threads: int) -> "FitState | None":
        """Read a checkpoint; return None if it is missing or damaged."""
        if not path.is_file():
            return None
        try:
            arrays = read_npz(path)
            generator = np.random.default_rng()
            generator.bit_generator.state = json.loads(arrays["generator"].item())
            restored = model.restore(arrays, threads)
            return FitState(restored, generator, arrays["order"].tolist(), arrays["curve"].tolist())
        except (ArtifactError, KeyError, TypeError, ValueError) as error:
            logger.warning("ignoring the checkpoint and restarting the fit: %s", error)
            return None


def fit_step(state: FitState, views: list[TrainingView], settings: GaussiansSettings, extent: float) -> None:
    """Take one optimiser step on one view, then control density if due."""
    if not state.order:
        state.order = state.generator.permutation(len(views)).tolist()
    view = views[state.order.pop()]
    model, progress = state.model, state.model.steps / settings.iterations
    # 3DGS adds a degree every 1000 of 30 000 steps; here, every fit reaches degree 3 after 30 % of its steps
    degree = min(settings.sh_degree, int(progress * 10))
    background = np.full(3, settings.background == "white", np.float32)
    if settings.background == "random":
        background = state.generator.uniform(size=3).astype(np.float32)
    is_frozen = settings.initial == "frozen"
    rate = 0.0 if is_frozen else means_rate(settings, progress)
    is_early = model.steps < int(settings.densify_until * settings.iterations)
    is_watched = is_early and not is_frozen and settings.strategy == "default"
    scores = model.step(view, settings, extent, StepOptions(degree, background, rate, is_watched))
    if model.steps % CURVE_EVERY == 0:
        loss, error = scores()
        psnr_db = -10 * np.log10(max(error, 10 ** (-MAX_PSNR_DB / 10)))
        state.curve.append([model.steps, loss, psnr_db, len(model)])
    if not is_frozen:
        control_density(model, settings, rate, extent, state.generator)


def scale_at(settings: GaussiansSettings, progress: float, side_px: int) -> float:
    """Return the scale of the training images, which grows with `progress` (the share of completed steps).

    Coarse images are cheaper, and their wider gradients move Gaussians over larger distances.
    `side_px` is the shorter side of the images at full size.
    """
    scale = 0.25 if progress < settings.quarter_until else 0.5 if progress < settings.half_until else 1.0
    while scale < 1 and scale * side_px < MIN_SIDE_PX:
        scale *= 2
    return scale


@explained_memory(MEMORY_USER, MEMORY_FIX)
def fit_gaussians(
    scene: Scene,
    settings: GaussiansSettings,
    *,
    seed: int,
    threads: int = 1,
    checkpoint: Path | None = None,
    device: Device | None = None,
) -> tuple[Gaussians, Float64[np.ndarray, "S 4"]]:
    """Fit Gaussians to the training views of a scene.

    On the CPU, the result is byte-identical for any number of threads, even if the fit was interrupted and
    resumed. A card adds gradients in varying order, so its results vary within rounding.

    Args:
        seed: determines the view order, splits, relocations, noise and random points.
        checkpoint: file to which the state is written every `checkpoint_every` steps, and from which
            an interrupted fit with the same inputs resumes; removed at the end.
        device: device to use; by default, the result of `fit_device`.

    Returns:
        The Gaussians in Morton order (frozen ones in the order of their points), and the
        training curve: rows of (step, loss, training PSNR, number of Gaussians).

    Raises:
        SceneError: if there are no training views, or no Gaussians are left.
        DeviceError: if `settings.device` is `cuda` and cannot be used, or the card's memory runs out.
    """
    views = load_views(scene, "train", settings.image_scale)
    if not views:
        raise SceneError(f"{scene.name} has no training views", fix="hold out fewer views (poses.test_every)")
    model_class = model_on(device or fit_device(scene, settings))
    settings = settings.model_copy(update={"iterations": fit_steps(settings, len(views))})
    cameras = [view.camera for view in views]
    extent = camera_extent(cameras)
    state = FitState.load(checkpoint, model_class, threads) if checkpoint else None
    if state is None:
        generator = np.random.default_rng(seed)
        start = first_gaussians(scene, cameras, settings, generator)
        state = FitState(model_class(start, threads), generator)
    else:
        logger.info("resuming from the checkpoint at step %d", state.model.steps)
    model, sizes = state.model, {1.0: views}
    for step in track(range(model.steps, settings.iterations), "fit steps"):
        scale = scale_at(settings, step / settings.iterations, min(cameras[0].size_hw))
        if scale not in sizes:
            sizes[scale] = load_views(scene, "train", scale * settings.image_scale)
        fit_step(state, sizes[scale], settings, extent)
        if len(model) == 0:
            break
        if checkpoint and (step + 1) % settings.checkpoint_every == 0 and step + 1 < settings.iterations:
            state.save(checkpoint)
    if settings.initial != "frozen":
        prune(model, settings, extent)
        model.select(morton_order(model.read("means")))
    if len(model) == 0:
        raise SceneError(
            f"all Gaussians of {scene.name} became transparent",
            fix="check the poses (registration.png), or lower gaussians.min_opacity",
        )
    if checkpoint:
        delete(checkpoint, r"[0-9a-f]{16}\.npz")
    return model.as_gaussians(), np.array(state.curve).reshape(-1, 4)


def fit_device(scene: Scene, settings: GaussiansSettings) -> Device:
    """Return the device that `settings.device` selects, if its memory suffices (see `require_card_memory`).

    Raises:
        DeviceError: if `settings.device` is `cuda` and cannot be used.
    """
    if choose_device(settings.device) == "cpu":
        return "cpu"
    from hilsplat.splat.torch_model import bytes_needed

    cameras = [scene.cameras[name] for name in scene.views("train")]
    pixels = [int(settings.image_scale**2 * math.prod(camera.size_hw)) for camera in cameras]
    number = settings.max_gaussians if settings.initial != "frozen" else len(scene.points_xyz)
    needed = bytes_needed(number, (settings.sh_degree + 1) ** 2, pixels)
    return require_card_memory(settings.device, needed, MEMORY_USER, MEMORY_FIX)


def write_report(
    folder: Path,
    gaussians: Gaussians,
    scene: Scene,
    curve: Float64[np.ndarray, "S 4"] | None,
    origin: dict[str, Any],
    settings: GaussiansSettings,
    threads: int,
) -> dict[str, Any]:
    """Write the report folder and return the contents of report.json.

    The training views are scored if the scene has no held-out views. `curve` is the training curve from
    `fit_gaussians`, or None for imported Gaussians.
    """
    background = (float(settings.background == "white"),) * 3

    def picture(camera: Camera, threads: int = threads) -> UInt8[np.ndarray, "H W 3"]:
        color = render(gaussians, camera, background=background, threads=threads).colours
        return np.round(color.clip(0, 1) * 255).astype(np.uint8)

    test, train = (load_views(scene, split, settings.image_scale) for split in ("test", "train"))
    views, split = (test, "test") if test else (train, "train")
    scores: dict[str, dict[str, float]] = {}
    gains: list[float] = []  # over a flat colour in dB, of each view that has more than one colour
    cells: list[UInt8[np.ndarray, "_ _ 3"]] = []
    titles: list[str] = []
    for view in views:
        rendering = picture(view.camera)  # scored as a saved 8-bit image
        values, truth = to_float(rendering), to_float(view.image)
        psnr_db = min(psnr(values, truth), MAX_PSNR_DB)
        scores[view.camera.name] = {"psnr_db": psnr_db, "ssim": ssim(values, truth)}
        if np.ptp(view.image, axis=(0, 1)).any():
            gains.append(psnr_db - psnr(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape), truth))
        if len(cells) < 3 * MAX_SHOWN:
            error = np.abs(view.image.astype(np.int32) - rendering) * ERROR_GAIN
            cells += [view.image, rendering, np.minimum(error, 255).astype(np.uint8)]
            titles += [view.camera.name, f"fit, {psnr_db:.1f} dB", f"error x {ERROR_GAIN}"]
    report: dict[str, Any] = {
        "split": split,
        **{name: float(np.mean([score[name] for score in scores.values()])) for name in ("psnr_db", "ssim")},
        "gaussians": len(gaussians),
        "origin": origin,
        "image_scale": settings.image_scale,
        "warnings": [],
        "views": scores,
    }
    if gains and np.mean(gains) <= 0:
        report["warnings"].append(
            f"the {split} views score {report['psnr_db']:.1f} dB, no better than a single flat colour: check "
            "test_views.png; the Gaussians and the cameras may use different coordinates, or the poses "
            "may be wrong"
        )
    with atomic_folder(folder) as temporary:
        write_png(temporary / "test_views.png", contact_sheet(cells, 6, titles))
        path = [view.camera for view in train or views]
        write_flyaround(temporary, path, lambda camera: picture(camera, 1), threads)
        if curve is not None:
            _draw_curves(temporary / "curves.png", curve)
        write_json(temporary / "report.json", report)
        summary = {name: report[name] for name in ("split", "psnr_db", "ssim", "gaussians")}
        write_index(temporary, scores, **summary)
    for warning in report["warnings"]:
        logger.warning("%s: %s", scene.name, warning)
    return report


def _draw_curves(path: Path, curve: Float64[np.ndarray, "S 4"]) -> None:
    """Plot the loss, training PSNR and number of Gaussians against the step."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    titles = ("loss", "PSNR of the step's view, dB", "Gaussians")
    for axes, values, title in zip(figure.subplots(1, 3), curve[:, 1:].T, titles, strict=True):
        axes.plot(curve[:, 0], values, linewidth=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100, metadata={"Software": None})


def run_gaussians(
    scene_folder: Path,
    out_ply: Path,
    out_report: Path,
    cache: Path,
    settings: GaussiansSettings,
    seed: int,
    threads: int,
    existing: Path | None = None,
    dataparser: Path | None = None,
    transforms: Path | None = None,
) -> None:
    """Fit Gaussians or import existing ones; write the PLY, the JSON file beside it and the report folder.

    Args:
        existing: a 3DGS PLY in the coordinates of the scene's source, used instead of a fit.
        dataparser, transforms: for a PLY in nerfstudio's training coordinates (see `import_gaussians`).

    Raises:
        SceneError: if there are no training views to fit.
        ArtifactError: if `existing` cannot be used.
    """
    scene = Scene.load(scene_folder)
    with stage_log("gaussians", scene.name) as counts:
        curve = None
        if existing is not None:
            gaussians, origin = import_gaussians(existing, scene, dataparser, transforms)
        else:
            # a fit must resume on the same device, because sums differ between CPU and CUDA
            device = fit_device(scene, settings)
            values = settings.model_dump(mode="json") | {"device": device}
            key = sha256_of_json([values, seed, sha256_of_path(scene_folder), code_digest(fit_gaussians)])
            checkpoint = Path(cache) / "gaussians" / f"{key[:16]}.npz"
            gaussians, curve = fit_gaussians(
                scene, settings, seed=seed, threads=threads, checkpoint=checkpoint, device=device
            )
            origin = {
                "kind": "fitted",
                "strategy": "frozen" if settings.initial == "frozen" else settings.strategy,
                "iterations": fit_steps(settings, len(scene.views("train"))),
                "seed": seed,
            }
        report = write_report(out_report, gaussians, scene, curve, origin, settings, threads)
        save_ply(out_ply, gaussians)
        write_coordinates(out_ply, scene, gaussians, origin)
        counts.update(
            gaussians=len(gaussians),
            psnr=f"{report['psnr_db']:.2f} dB",
            ssim=f"{report['ssim']:.3f} ({report['split']})",
        )
