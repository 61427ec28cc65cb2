"""Report of a fit: scores on held-out views, curves, pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation, Slerp

from hilsplat.base.artifacts import atomic_folder, write_index, write_json
from hilsplat.base.images import to_float, write_png
from hilsplat.scene.cameras import Camera
from hilsplat.settings import GaussiansSettings
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.photometric import psnr, ssim
from hilsplat.splat.rasterise.api import render

MAX_PAIRS = 8
FLY_VIEWS = 12
MAX_SIDE_PX = 320
"""Longer side of a picture on a contact sheet."""


def write_report(
    folder: Path,
    gaussians: Gaussians,
    targets: dict[str, tuple[Camera, UInt8[np.ndarray, "H W 3"]]],
    split: str,
    path: list[Camera],
    curve: Float[np.ndarray, "S 4"],
    settings: GaussiansSettings,
    threads: int,
) -> dict[str, Any]:
    """Write report.json, curves.png, test_views.png, flyaround.png and the index; return the report.

    Args:
        targets: views that are scored: camera and true image.
        split: whether these were held out ("test") or fitted ("train", where there is no other).
        path: cameras between which the fly-around moves.
        curve: rows of (step, loss, training PSNR in dB, number of Gaussians).
    """
    background = {"white": (1.0, 1.0, 1.0)}.get(settings.background, (0.0, 0.0, 0.0))

    def picture(camera: Camera) -> np.ndarray:
        color = render(gaussians, camera, background=background, threads=threads).color
        return color.detach().clamp(0, 1).numpy()

    scores, pairs = {}, []
    for name, (camera, image) in targets.items():
        shown, truth = picture(camera), to_float(image)
        # scored as the 8-bit image one would save
        eight_bit = np.round(shown * 255).astype(np.float32) / np.float32(255)
        scores[name] = {"psnr_db": psnr(eight_bit, truth), "ssim": ssim(eight_bit, truth)}
        if len(pairs) < MAX_PAIRS:
            pairs.append([image, np.round(shown * 255).astype(np.uint8)])
    report = {
        "split": split,
        "psnr_db": float(np.mean([score["psnr_db"] for score in scores.values()])),
        "ssim": float(np.mean([score["ssim"] for score in scores.values()])),
        "gaussians": len(gaussians),
        "iterations": settings.iterations,
        "image_scale": settings.image_scale,
        "views": scores,
    }
    fly = [np.round(picture(camera) * 255).astype(np.uint8) for camera in _between(path, FLY_VIEWS)]
    with atomic_folder(folder) as temporary:
        write_json(temporary / "report.json", report)
        write_png(temporary / "test_views.png", _sheet([cell for pair in pairs for cell in pair], columns=4))
        write_png(temporary / "flyaround.png", _sheet(fly, columns=4))
        _draw_curves(temporary / "curves.png", curve)
        write_index(
            temporary,
            scores,
            split=split,
            psnr_db=report["psnr_db"],
            ssim=report["ssim"],
            gaussians=len(gaussians),
        )
    return report


def _between(path: list[Camera], number: int) -> list[Camera]:
    """Cameras half-way between neighbours of the path, evenly picked."""
    if len(path) < 2:
        return path
    out = []
    for at in np.unique(np.linspace(0, len(path) - 2, number).astype(int)):
        a, b = path[at], path[at + 1]
        rotations = Rotation.from_matrix(np.stack([a.cam_from_world[:3, :3], b.cam_from_world[:3, :3]]))
        pose = np.eye(4)
        pose[:3, :3] = Slerp([0, 1], rotations)(0.5).as_matrix()
        pose[:3, 3] = -pose[:3, :3] @ (a.centre + b.centre) / 2
        out.append(Camera("between", pose, a.K, a.size_hw))
    return out


def _sheet(pictures: list[UInt8[np.ndarray, "_ _ 3"]], columns: int) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures on a white sheet, shrunk by whole factors to at most MAX_SIDE_PX."""
    cells = []
    for picture in pictures:
        step = -(-max(picture.shape[:2]) // MAX_SIDE_PX)
        cells.append(picture[::step, ::step])
    height, width = (max(cell.shape[axis] for cell in cells) + 4 for axis in (0, 1))
    rows = -(-len(cells) // columns)
    sheet = np.full((rows * height, min(columns, len(cells)) * width, 3), 255, np.uint8)
    for k, cell in enumerate(cells):
        y, x = (k // columns) * height, (k % columns) * width
        sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


def _draw_curves(path: Path, curve: Float[np.ndarray, "S 4"]) -> None:
    """Loss, training PSNR and number of Gaussians over the steps."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3), layout="constrained")
    FigureCanvasAgg(figure)
    steps = curve[:, 0]
    for axes, values, title in zip(
        figure.subplots(1, 3),
        curve[:, 1:].T,
        ("loss", "PSNR of the step's view, dB", "Gaussians"),
        strict=True,
    ):
        axes.plot(steps, values, linewidth=0.8)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=100, metadata={"Software": None})
