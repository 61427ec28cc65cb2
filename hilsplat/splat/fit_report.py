"""Report of a fit: scores on held-out views, curves, pictures and fly-around."""

import logging
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from hilsplat.base.artifacts import atomic_folder, write_index, write_json
from hilsplat.base.images import to_float, write_png
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.flyaround import contact_sheet, write_flyaround
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.photometric import psnr, ssim
from hilsplat.splat.rasterise.api import render
from hilsplat.splat.views import load_views

logger = logging.getLogger(__name__)

MAX_SHOWN = 8
"""Maximum number of views on the sheet of test views."""
SUMMARY = ("split", "psnr_db", "ssim", "gaussians")
"""Entries of the report that the index repeats."""
ERROR_GAIN = 4
"""Factor by which displayed errors are magnified."""


def write_report(
    folder: Path,
    gaussians: Gaussians,
    scene: Scene,
    curve: Float[np.ndarray, "S 4"] | None,
    origin: dict[str, Any],
    settings: GaussiansSettings,
    threads: int,
) -> dict[str, Any]:
    """Write the report folder and return the content of report.json.

    It contains `report.json`, `test_views.png` (photograph, rendering, error), `flyaround.mp4`,
    `flyaround.png`, `curves.png` after a fit, and the index.

    The training views are scored if the scene has no held-out views. `curve` is that of `fit_gaussians`; None
    for imported Gaussians.
    """
    background = {"white": (1.0, 1.0, 1.0)}.get(settings.background, (0.0, 0.0, 0.0))

    def picture(camera: Camera, threads: int = threads) -> UInt8[np.ndarray, "H W 3"]:
        color = render(gaussians, camera, background=background, threads=threads).color
        return np.round(color.clip(0, 1) * 255).astype(np.uint8)

    views, split = load_views(scene, "test", settings.image_scale), "test"
    if not views:
        views, split = load_views(scene, "train", settings.image_scale), "train"
    scores: dict[str, dict[str, float]] = {}
    flat: list[float] = []
    cells: list[UInt8[np.ndarray, "_ _ 3"]] = []
    for view in views:
        shown = picture(view.camera)  # scored as a saved 8-bit image
        drawn, truth = to_float(shown), to_float(view.image)
        scores[view.name] = {"psnr_db": psnr(drawn, truth), "ssim": ssim(drawn, truth)}
        flat.append(psnr(np.broadcast_to(truth.mean(axis=(0, 1)), truth.shape), truth))
        if len(cells) < 3 * MAX_SHOWN:
            error = np.abs(view.image.astype(np.int32) - shown) * ERROR_GAIN
            cells += [view.image, shown, np.minimum(error, 255).astype(np.uint8)]
    report: dict[str, Any] = {
        "split": split,
        "psnr_db": float(np.mean([score["psnr_db"] for score in scores.values()])),
        "ssim": float(np.mean([score["ssim"] for score in scores.values()])),
        "gaussians": len(gaussians),
        "origin": origin,
        "image_scale": settings.image_scale,
        "warnings": [],
        "views": scores,
    }
    if report["psnr_db"] <= np.mean(flat):
        report["warnings"].append(
            f"the {split} views score {report['psnr_db']:.1f} dB, no more than one flat colour does: look at "
            "test_views.png; the Gaussians may be in other coordinates than the cameras, or the poses "
            "may be wrong"
        )
    with atomic_folder(folder) as temporary:
        write_png(temporary / "test_views.png", contact_sheet(cells, columns=6))
        path = [view.camera for view in load_views(scene, "train", settings.image_scale) or views]
        write_flyaround(temporary, path, partial(picture, threads=1), threads)
        if curve is not None:
            _draw_curves(temporary / "curves.png", curve)
        write_json(temporary / "report.json", report)
        write_index(temporary, scores, **{name: report[name] for name in SUMMARY})
    for warning in report["warnings"]:
        logger.warning("%s: %s", scene.name, warning)
    return report


def _draw_curves(path: Path, curve: Float[np.ndarray, "S 4"]) -> None:
    """Plot loss, training PSNR and number of Gaussians over the steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    FigureCanvasAgg(figure)
    steps = curve[:, 0]
    titles = ("loss", "PSNR of the step's view, dB", "Gaussians")
    for axes, values, title in zip(figure.subplots(1, 3), curve[:, 1:].T, titles, strict=True):
        axes.plot(steps, values, linewidth=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100, metadata={"Software": None})
