"""Gaussians projected into a view, and passes over its tiles: blending, gradients, sparse weights.

Threads process ranges of Gaussians or tiles; nothing is summed across threads, so every result is
byte-identical for any number of threads.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from cpusplat.binning import Tiles, bin_gaussians, fill_lists
from cpusplat.blend import add_slots, blend, blend_backward, sparse_rows
from cpusplat.lanes import WIDTH, aligned
from cpusplat.project import GEOMETRY, MOMENTS, project, project_backward
from cpusplat.threads import over_edges, over_ranges


class Parameters(NamedTuple):
    """Unconstrained parameters of N Gaussians, or gradients with respect to them; float32."""

    means: np.ndarray  # [N, 3], scene units
    log_scales: np.ndarray  # [N, 3], natural log of the standard deviations, scene units
    quats: np.ndarray  # [N, 4], rotations (wxyz) of any non-zero length
    opacity_logits: np.ndarray  # [N], inverse sigmoid of the peak alpha
    sh: np.ndarray  # [N, K, 3], harmonics of the colour; row 0 is the constant term


@dataclass(frozen=True)
class Projected:
    """Gaussians projected into a view, ready to blend."""

    camera: np.ndarray  # output of `pack_camera`
    size_hw: tuple[int, int]
    parameters: Parameters
    degree: int  # of the spherical harmonics used
    broken: int  # number of Gaussians with a non-finite parameter or a zero quaternion
    geometry: np.ndarray  # float32 [N padded, 16]; see `project.GEOMETRY`
    box: np.ndarray  # int32 [N, 4], pixel box of each Gaussian; last < first if it is not drawn
    colours: np.ndarray  # float32 [N, 3], RGB in this view
    tiles: Tiles
    # the filled lists, if one band contains all tiles and was already filled
    only_band: list["Band"] = field(default_factory=list, repr=False)

    @property
    def drawn(self) -> np.ndarray:
        """Whether each Gaussian reaches a pixel of the view [N]."""
        return self.box[:, 1] >= self.box[:, 0]


def project_gaussians(parameters: Parameters, camera: np.ndarray, degree: int, threads: int) -> Projected:
    """Project all Gaussians into a view (`pack_camera`), and count them per tile."""
    n = len(parameters.means)
    groups = (n + WIDTH - 1) // WIDTH
    geometry = aligned(groups * WIDTH * GEOMETRY).reshape(-1, GEOMETRY)
    box = np.empty((n, 4), np.int32)
    colours = np.zeros((n, 3), np.float32)
    size_hw = int(camera[23]), int(camera[24])
    parameters = Parameters(*map(np.ascontiguousarray, parameters))
    arguments = (*parameters, degree, camera, geometry, box, colours)
    broken = sum(over_ranges(project, groups, threads, *arguments))
    tiles = bin_gaussians(box, geometry[:n, 6], size_hw)
    return Projected(camera, size_hw, parameters, degree, broken, geometry, box, colours, tiles)


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


def blend_forward(view: Projected, channels: np.ndarray, threads: int) -> tuple[np.ndarray, np.ndarray]:
    """Blend channels [N, C] of Gaussians into a premultiplied image [H, W, C] and alpha [H, W]."""
    image = np.empty((*view.size_hw, channels.shape[1]), np.float32)
    alpha = np.empty(view.size_hw, np.float32)
    for band in tile_lists(view, threads):
        band.over_tiles(blend, threads, view.geometry, channels, image, alpha)
    return image, alpha


def blend_gradients(
    view: Projected,
    channels: np.ndarray,
    image: np.ndarray,
    alpha: np.ndarray,
    grad_image: np.ndarray,
    grad_alpha: np.ndarray,
    threads: int,
) -> np.ndarray:
    """Compute sums [N padded, columns] from gradients of `blend_forward`'s outputs, given both.

    A row has `MOMENTS` sums from which `project_gradients` computes, then the gradients of the channels.
    """
    n = len(view.box)
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
    return sums


def project_gradients(view: Projected, sums: np.ndarray, threads: int) -> tuple[Parameters, np.ndarray]:
    """Compute gradients of the parameters and of the projected means [N, 2] from `blend_gradients`.

    The first three channels must be the view's colours, or else the gradients of `sh` are meaningless.
    """
    p = view.parameters
    out = Parameters(*(np.empty(table.shape, np.float32) for table in p))
    means_px = np.empty((len(view.box), 2), np.float32)
    tables = tuple(np.ravel(table) for table in (p.means, p.log_scales, p.quats, p.sh))
    arguments = (p.sh.shape[1], tables, view.degree, view.camera, view.geometry, sums)
    by_table = (out.means, out.log_scales, out.quats, out.sh, out.opacity_logits, means_px)
    grads = tuple(grad.reshape(-1) for grad in by_table)
    over_ranges(project_backward, len(view.geometry) // WIDTH, threads, *arguments, grads)
    return out, means_px


def sparse_weights(
    view: Projected, min_weight: float, threads: int, step: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the blending weights >= min_weight of each Gaussian at each pixel.

    Rows of pixels outside every `step`-th row and column of the image are empty.

    Returns:
        CSR arrays of a matrix (H W, N) with row-major pixels and sorted columns: data (float32), indices
        (int32) and indptr (int64).
    """
    counts = np.zeros(view.size_hw[0] * view.size_hw[1], np.int64)

    def over_bands(out: tuple[Any, ...] | None) -> None:
        for band in tile_lists(view, threads):
            arguments = (view.size_hw, step, view.geometry, np.float32(min_weight), counts, out)
            band.over_tiles(sparse_rows, threads, *arguments)

    over_bands(None)
    row_start = np.concatenate([[0], np.cumsum(counts)])
    columns, weights = np.empty(row_start[-1], np.int32), np.empty(row_start[-1], np.float32)
    if len(columns):
        over_bands((int(counts.max()), row_start, columns, weights))
    return weights, columns, row_start
