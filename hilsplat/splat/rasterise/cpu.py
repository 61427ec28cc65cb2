"""The CPU backend: projection, tile lists and blending over threads, on plain arrays.

Threads take ranges of Gaussians or tiles; nothing is summed across threads, so every result is the
same bytes for any number of them.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32

from hilsplat.base.errors import HilsplatError
from hilsplat.scene.cameras import Camera
from hilsplat.splat.rasterise.binning import TILE, TileLists, bin_gaussians
from hilsplat.splat.rasterise.blend import blend, blend_backward, blend_weights, sort_rows
from hilsplat.splat.rasterise.project import GEOMETRY, MOMENTS, pack_camera, project, project_backward


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rasterise")


def over_ranges(work: Callable[[int, int], Any], count: int, threads: int) -> list[Any]:
    """Call `work(begin, end)` over ranges that cover 0..count, on threads; results in range order."""
    if threads <= 1 or count <= 1:
        return [work(0, count)]
    edges = np.linspace(0, count, min(count, 4 * threads) + 1).astype(int).tolist()
    return list(_pool(threads).map(work, edges[:-1], edges[1:]))


@dataclass(frozen=True)
class Parameters:
    """Gaussians as contiguous float32 arrays; fields as in `Gaussians`."""

    means: Float32[np.ndarray, "N 3"]
    log_scales: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    opacity_logits: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]


@dataclass(frozen=True)
class Projected:
    """Gaussians of a view, ready to blend.

    Attributes:
        camera: packed camera row.
        size_hw: image size, px.
        degree: spherical-harmonics degree that was used.
        geometry: see `project.GEOMETRY`.
        box: pixel box of each Gaussian; last < first where it is not drawn.
        colours: RGB in this view.
        tiles: tile lists.
    """

    camera: Float64[np.ndarray, " 25"]
    size_hw: tuple[int, int]
    degree: int
    geometry: Float32[np.ndarray, "N 8"]
    box: Int32[np.ndarray, "N 4"]
    colours: Float32[np.ndarray, "N 3"]
    tiles: TileLists

    @property
    def tiles_x(self) -> int:
        """Tiles per row."""
        return (self.size_hw[1] + TILE - 1) // TILE

    @property
    def num_tiles(self) -> int:
        """Tiles of the view."""
        return self.tiles_x * ((self.size_hw[0] + TILE - 1) // TILE)


@dataclass(frozen=True)
class Gradients:
    """dL/d of each parameter, and of the projected means in pixels."""

    means: Float32[np.ndarray, "N 3"]
    log_scales: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    opacity_logits: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]
    features: Float32[np.ndarray, "N D"]
    means_px: Float32[np.ndarray, "N 2"]


def project_gaussians(parameters: Parameters, camera: Camera, degree: int, threads: int) -> Projected:
    """Project all Gaussians into a view and list them per tile.

    Raises:
        HilsplatError: parameters that are not finite, or quaternions of length zero.
    """
    n = len(parameters.means)
    geometry = np.zeros((n, GEOMETRY), np.float32)
    box = np.empty((n, 4), np.int32)
    colours = np.zeros((n, 3), np.float32)
    row = pack_camera(camera)
    p = parameters

    def work(begin: int, end: int) -> int:
        return project(
            begin,
            end,
            p.means,
            p.log_scales,
            p.quats,
            p.opacity_logits,
            p.sh,
            degree,
            row,
            geometry,
            box,
            colours,
        )

    broken = sum(over_ranges(work, n, threads))
    if broken:
        raise HilsplatError(
            f"{broken} of {n} Gaussians cannot be drawn: not finite, or a zero quaternion",
            expected="finite means, log_scales, quats, opacity_logits and sh",
            fix="drop these Gaussians, or run the gaussians stage again",
        )
    tiles = bin_gaussians(box, geometry[:, 6], camera.size_hw)
    return Projected(row, tuple(camera.size_hw), degree, geometry, box, colours, tiles)


def blend_forward(
    view: Projected, channels: Float32[np.ndarray, "N C"], threads: int
) -> tuple[Float32[np.ndarray, "H W C"], Float32[np.ndarray, "H W"]]:
    """Blend per-Gaussian channels: premultiplied image and alpha."""
    image = np.empty((*view.size_hw, channels.shape[1]), np.float32)
    alpha = np.empty(view.size_hw, np.float32)
    t = view.tiles
    over_ranges(
        lambda begin, end: blend(
            begin,
            end,
            view.tiles_x,
            t.tile_start,
            t.gaussian,
            view.geometry,
            view.box,
            channels,
            image,
            alpha,
        ),
        view.num_tiles,
        threads,
    )
    return image, alpha


def blend_gradients(
    parameters: Parameters,
    view: Projected,
    channels: Float32[np.ndarray, "N C"],
    image: Float32[np.ndarray, "H W C"],
    alpha: Float32[np.ndarray, "H W"],
    grad_image: Float32[np.ndarray, "H W C"],
    grad_alpha: Float32[np.ndarray, "H W"],
    threads: int,
) -> Gradients:
    """Gradients of the parameters from those of the premultiplied image and alpha.

    Args:
        channels: what was blended: the view's colours in the first 3 columns, then features.
        image, alpha: what `blend_forward` returned.
    """
    t, n = view.tiles, len(parameters.means)
    slots = np.zeros((len(t.gaussian), MOMENTS + channels.shape[1]), np.float32)
    over_ranges(
        lambda begin, end: blend_backward(
            begin,
            end,
            view.tiles_x,
            t.tile_start,
            t.gaussian,
            t.pair,
            view.geometry,
            view.box,
            channels,
            image,
            alpha,
            grad_image,
            grad_alpha,
            slots,
        ),
        view.num_tiles,
        threads,
    )
    p = parameters
    out = Gradients(
        np.zeros_like(p.means),
        np.zeros_like(p.log_scales),
        np.zeros_like(p.quats),
        np.zeros_like(p.opacity_logits),
        np.zeros_like(p.sh),
        np.zeros((n, channels.shape[1] - 3), np.float32),
        np.zeros((n, 2), np.float32),
    )
    over_ranges(
        lambda begin, end: project_backward(
            begin,
            end,
            p.means,
            p.log_scales,
            p.quats,
            p.sh,
            view.degree,
            view.camera,
            view.geometry,
            view.colours,
            t.pair_start,
            slots,
            out.means,
            out.log_scales,
            out.quats,
            out.opacity_logits,
            out.sh,
            out.features,
            out.means_px,
        ),
        n,
        threads,
    )
    return out


def sparse_weights(
    view: Projected, min_weight: float, threads: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blending weights >= min_weight as CSR arrays (row starts, columns, weights), one row per pixel.

    Rows are row-major pixels; columns ascend within a row. Row starts are int64.
    """
    t = view.tiles
    pixels = view.size_hw[0] * view.size_hw[1]
    count = np.zeros(pixels, np.int64)

    def walk(cursor: np.ndarray, columns: np.ndarray, weights: np.ndarray) -> None:
        over_ranges(
            lambda begin, end: blend_weights(
                begin,
                end,
                view.tiles_x,
                view.size_hw,
                t.tile_start,
                t.gaussian,
                view.geometry,
                view.box,
                np.float32(min_weight),
                cursor,
                columns,
                weights,
            ),
            view.num_tiles,
            threads,
        )

    walk(count, np.empty(0, np.int32), np.empty(0, np.float32))
    row_start = np.concatenate([[0], np.cumsum(count)])
    columns, weights = np.empty(row_start[-1], np.int32), np.empty(row_start[-1], np.float32)
    if len(columns):
        walk(row_start[:-1].copy(), columns, weights)
        over_ranges(lambda begin, end: sort_rows(begin, end, row_start, columns, weights), pixels, threads)
    return row_start, columns, weights
