"""CPU backend: multi-threaded projection, tile lists and blending on plain arrays.

Threads process ranges of Gaussians or tiles; nothing is summed across threads, so every result is
byte-identical for any number of threads.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from scipy.sparse import csr_matrix

from cpusplat.lanes import WIDTH, aligned
from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import over_edges
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.binning import Tiles, bin_gaussians, fill_lists
from hilsplat.splat.rasterise.blend import add_slots, blend, blend_backward, sparse_rows
from hilsplat.splat.rasterise.project import GEOMETRY, MOMENTS, pack_camera, project, project_backward

RANGES_PER_THREAD = 4  # number of work ranges per thread; several ranges balance the load


def over_ranges(
    work: Callable[..., Any], count: int, threads: int, *arguments: Any, first: int = 0
) -> list[Any]:
    """Call `work(begin, end, *arguments)` in threads for ranges of `count` items, starting at `first`."""
    pieces = min(count, RANGES_PER_THREAD * threads) if threads > 1 and count > 1 else 1
    edges = first + np.linspace(0, count, pieces + 1).astype(int)
    return over_edges(work, edges.tolist(), threads, *arguments)


@dataclass(frozen=True)
class Projected:
    """Gaussians projected into a view, ready to blend."""

    camera: Float64[np.ndarray, " 25"]  # output of `pack_camera`
    size_hw: tuple[int, int]
    degree: int  # of the spherical harmonics used
    geometry: Float32[np.ndarray, "N_padded 16"]  # see `project.GEOMETRY`
    box: Int32[np.ndarray, "N 4"]  # pixel box of each Gaussian; last < first if it is not drawn
    colours: Float32[np.ndarray, "N 3"]  # RGB in this view
    tiles: Tiles
    # the filled lists, if one band contains all tiles and was already filled
    only_band: list["Band"] = field(default_factory=list, repr=False)


@dataclass(frozen=True)
class Gradients:
    """Gradients with respect to each parameter, and to the projected means in pixels."""

    means: Float32[np.ndarray, "N 3"]
    log_scales: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    opacity_logits: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]
    features: Float32[np.ndarray, "N D"]
    means_px: Float32[np.ndarray, "N 2"]


@dataclass(frozen=True)
class Drawn:
    """One view as drawn by either backend."""

    image: Float32[np.ndarray, "H W C"]  # premultiplied RGB, then features, without background
    alpha: Float32[np.ndarray, "H W"]  # coverage in [0, 1], the sum of the blending weights
    drawn: Bool[np.ndarray, " N"]  # whether each Gaussian reaches a pixel of the view
    # maps gradients of image and alpha to gradients of the parameters
    gradients: Callable[[np.ndarray, np.ndarray], Gradients]


def refuse_broken(broken: int, total: int) -> None:
    """Raise HilsplatError if any Gaussian cannot be drawn."""
    if broken:
        raise HilsplatError(
            f"{broken} of {total} Gaussians cannot be drawn: non-finite parameters or a zero quaternion",
            expected="finite means, log_scales, quats, opacity_logits and sh",
            fix="drop these Gaussians, or rerun the gaussians stage",
        )


def project_gaussians(gaussians: Gaussians, camera: Camera, degree: int, threads: int) -> Projected:
    """Project all Gaussians into a view, and count them per tile; raise the errors of `api.draw`."""
    n = len(gaussians)
    groups = (n + WIDTH - 1) // WIDTH
    geometry = aligned(groups * WIDTH * GEOMETRY).reshape(-1, GEOMETRY)
    box = np.empty((n, 4), np.int32)
    colours = np.zeros((n, 3), np.float32)
    row = pack_camera(camera)
    tables = (np.ascontiguousarray(getattr(gaussians, name)) for name in FIELDS)
    known = (*tables, degree, row)
    refuse_broken(sum(over_ranges(project, groups, threads, *known, geometry, box, colours)), n)
    tiles = bin_gaussians(box, geometry[:n, 6], camera.size_hw)
    return Projected(row, camera.size_hw, degree, geometry, box, colours, tiles)


@dataclass(frozen=True)
class Band:
    """Filled lists of tiles begin..end, as arguments of the kernels (see `blend`)."""

    begin: int
    end: int
    lists: tuple[Any, ...]  # base, tiles_x, tile_start, tile_end, gaussian, reach (a bit per block)

    def over_tiles(self, work: Callable[..., Any], threads: int, *arguments: Any) -> None:
        """Call `work(begin, end, *lists, *arguments)` on threads, for ranges that cover the band's tiles."""
        over_ranges(work, self.end - self.begin, threads, *self.lists, *arguments, first=self.begin)


def tile_lists(view: Projected, threads: int) -> Iterator[Band]:
    """Fill the tile lists one band of tiles at a time, so that memory is bounded.

    If one band contains all tiles, it is kept for the next pass over the view.
    """
    if view.only_band:
        yield view.only_band[0]
        return
    t = view.tiles
    bands, tile_end = t.bands(), np.empty_like(t.tile_start)
    for begin, end in bands:
        base = int(t.tile_start[begin])
        entries = int(t.tile_start[end]) - base
        # reach is read 64 words at a time
        gaussian, reach = np.empty(entries, np.int32), np.empty(entries + 64, np.uint16)
        # every range reads the whole depth order: use one range per thread, with equal numbers of entries
        shares = base + np.linspace(0, entries, max(threads, 1) + 1)
        edges = np.searchsorted(t.tile_start, shares[1:-1]).clip(begin, end).tolist()
        filled = (view.box, view.geometry, gaussian, reach, tile_end)
        over_edges(fill_lists, [begin, *edges, end], threads, base, t.tiles_x, t.order, t.tile_start, *filled)
        band = Band(begin, end, (base, t.tiles_x, t.tile_start, tile_end, gaussian, reach))
        if len(bands) == 1:
            view.only_band.append(band)
        yield band


def blend_forward(
    view: Projected, channels: Float32[np.ndarray, "N C"], threads: int
) -> tuple[Float32[np.ndarray, "H W C"], Float32[np.ndarray, "H W"]]:
    """Blend channels of Gaussians into a premultiplied image and alpha."""
    image = np.empty((*view.size_hw, channels.shape[1]), np.float32)
    alpha = np.empty(view.size_hw, np.float32)
    for band in tile_lists(view, threads):
        band.over_tiles(blend, threads, view.geometry, channels, image, alpha)
    return image, alpha


def blend_gradients(
    gaussians: Gaussians,
    view: Projected,
    channels: Float32[np.ndarray, "N C"],  # colours, then features
    image: Float32[np.ndarray, "H W C"],
    alpha: Float32[np.ndarray, "H W"],
    grad_image: Float32[np.ndarray, "H W C"],
    grad_alpha: Float32[np.ndarray, "H W"],
    threads: int,
) -> Gradients:
    """Compute gradients from those of `blend_forward`'s outputs."""
    p, n = gaussians, len(gaussians)
    columns = MOMENTS + channels.shape[1]
    width = (columns + WIDTH - 1) // WIDTH * WIDTH
    sums = aligned(len(view.geometry) * width).reshape(-1, width)
    sums[:] = 0.0
    pixels = (image, alpha, grad_image, grad_alpha)
    for band in tile_lists(view, threads):
        base, _, tile_start, tile_end, gaussian, _ = band.lists
        slots = aligned(len(gaussian) * columns + WIDTH)
        band.over_tiles(blend_backward, threads, view.geometry, channels, pixels, slots, columns)
        # every range reads all entries: use one range per thread
        edges = np.linspace(0, n, max(threads, 1) + 1).astype(int).tolist()
        listed = ((band.begin, band.end), base, tile_start, tile_end, gaussian)
        over_edges(add_slots, edges, threads, *listed, slots, columns, sums)
    out = Gradients(
        **{name: np.empty(getattr(p, name).shape, np.float32) for name in FIELDS},
        features=sums[:n, MOMENTS + 3 : columns].copy(),
        means_px=np.empty((n, 2), np.float32),
    )
    tables = tuple(np.ravel(table) for table in (p.means, p.log_scales, p.quats, p.sh))
    known = (p.sh.shape[1], tables, view.degree, view.camera, view.geometry, sums)
    by_table = (out.means, out.log_scales, out.quats, out.sh, out.opacity_logits, out.means_px)
    grads = tuple(grad.reshape(-1) for grad in by_table)
    over_ranges(project_backward, len(view.geometry) // WIDTH, threads, *known, grads)
    return out


def sparse_weights(view: Projected, min_weight: float, threads: int) -> csr_matrix:
    """Return the blending weights >= min_weight; see `api.pixel_weights`."""
    counts = np.zeros(view.size_hw[0] * view.size_hw[1], np.int64)

    def over_bands(out: tuple[Any, ...] | None) -> None:
        for band in tile_lists(view, threads):
            known = (view.size_hw, view.geometry, np.float32(min_weight), counts, out)
            band.over_tiles(sparse_rows, threads, *known)

    over_bands(None)
    row_start = np.concatenate([[0], np.cumsum(counts)])
    columns, weights = np.empty(row_start[-1], np.int32), np.empty(row_start[-1], np.float32)
    if len(columns):
        over_bands((int(counts.max()), row_start, columns, weights))
    return weight_matrix(row_start, columns, weights, len(view.box))


def weight_matrix(
    row_start: np.ndarray, columns: np.ndarray, weights: np.ndarray, num_gaussians: int
) -> csr_matrix:
    """Build a matrix from CSR arrays with sorted columns; scipy converts row starts to int32 if they fit."""
    shape = (len(row_start) - 1, num_gaussians)
    matrix = csr_matrix((weights, columns, row_start), shape=shape, copy=False)
    matrix.has_sorted_indices = True
    return matrix
