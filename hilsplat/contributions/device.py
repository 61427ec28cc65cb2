"""Contributions of a view on a card, equal to those of `view_matrices` up to rounding.

gsplat's entries of W stay on the card. A run of a mask's pixels is a range of entries. The entries of a few
masks at a time are sorted by mask and Gaussian, and equal pairs are summed.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Int64
from torch import Tensor

from hilsplat.contributions.compositing import MIN_ALPHA
from hilsplat.contributions.view_matrices import label_maps, random_half, scaled_matrices
from hilsplat.scene.cameras import Camera
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.splat.rasterise.cuda import CardCamera, Entries, pixel_weights, starts_of

MAX_LISTED = 2**24
"""Maximum number of entries sorted at once, unless one mask has more; they take about 100 bytes each."""


def drawn_weights(g: dict[str, Tensor], camera: Camera, *, min_weight: float) -> Entries:
    """Return the normalised weights of Gaussians (see `cuda.on_device`) in a view."""
    return normalised_entries(pixel_weights(g, CardCamera.of(camera), min_weight))


def normalised_entries(weights: Entries) -> Entries:
    """Return what `compositing.normalised_weights` returns for the same weights."""
    pixel, count = weights.pixel, weights.start.diff()
    alpha = torch.segment_reduce(weights.weight.double(), "sum", lengths=count)
    covered = alpha >= MIN_ALPHA
    used = covered[pixel]
    weight = (weights.weight / alpha[pixel]).float()
    return Entries(starts_of(count * covered), weights.gaussian[used], weight[used], weights.num_gaussians)


def view_contributions(view: str, weights: Entries, masks: HierarchicalMasks) -> dict[str, np.ndarray]:
    """Return what `view_matrices.view_contributions` returns for the same normalised weights."""
    device, maps, num_gaussians = weights.weight.device, label_maps(masks), weights.num_gaussians
    labels, half, level, *runs = (
        torch.from_numpy(array).to(device)
        for array in (maps, random_half(view, len(maps)), masks.level.astype(np.int64) - 1, *_runs(masks))
    )
    mask_of_run, begin, end = runs
    first, count, pixel = weights.start[begin], weights.start[end] - weights.start[begin], weights.pixel
    of_masks = torch.zeros(len(masks), dtype=torch.int64, device=device).index_add_(0, mask_of_run, count)
    pairs, sums = [], []
    for chosen in _batches(starts_of(mask_of_run.bincount(minlength=len(masks))), of_masks.tolist()):
        # list the entries of all runs: the run of each, and its number within the run
        run = torch.arange(len(first), device=device)[chosen].repeat_interleave(count[chosen])
        within = torch.arange(len(run), device=device) - starts_of(count[chosen])[run - chosen.start]
        entry = first[run] + within
        pair, order = torch.sort(mask_of_run[run] * num_gaussians + weights.gaussian[entry], stable=True)
        mask, at = pair // num_gaussians, pixel[entry[order]]
        painted = labels[at, level[mask]] == mask
        parts = torch.stack([torch.ones_like(painted), painted, painted & half[at]], dim=1)
        pair, length = pair.unique_consecutive(return_counts=True)
        terms = parts * weights.weight[entry[order]].double()[:, None]
        sums.append(torch.segment_reduce(terms, "sum", lengths=length, axis=0, unsafe=True))
        pairs.append(pair)
    pair = torch.cat(pairs)
    covered = weights.start.diff() > 0
    painted, in_half = (
        (labels[pixels] + 1).reshape(-1).bincount(minlength=len(masks) + 1)[1:]
        for pixels in (covered, covered & half)
    )
    mass = torch.zeros(num_gaussians, dtype=torch.float64, device=device)
    mass.index_add_(0, weights.gaussian, weights.weight.double())
    sizes = (pair // num_gaussians).bincount(minlength=len(masks))
    tensors = painted, in_half, sizes, (pair % num_gaussians).int(), torch.cat(sums), mass.float()
    return scaled_matrices(*(tensor.cpu().numpy() for tensor in tensors))


def _runs(masks: HierarchicalMasks) -> tuple[Int64[np.ndarray, " R"], ...]:
    """Return the mask, begin and end (pixels) of each run inside a mask."""
    lengths = masks.runs.astype(np.int64)
    owner = np.repeat(np.arange(len(masks)), np.diff(masks.offsets))
    ends = np.cumsum(lengths)
    ends -= np.concatenate([[0], ends])[masks.offsets[:-1]][owner]  # relative to the mask's first pixel
    inside = (np.arange(len(lengths)) - masks.offsets[owner]) % 2 == 1
    return owner[inside], (ends - lengths)[inside], ends[inside]


def _batches(first_run: Int64[Tensor, " M_and_1"], of_masks: list[int]) -> Iterator[slice]:
    """Group consecutive masks with at most MAX_LISTED entries together, and return the runs of each group."""
    edges, total = [0], 0
    for mask, entries in enumerate(of_masks):
        if total + entries > MAX_LISTED and mask > edges[-1]:
            edges.append(mask)
            total = 0
        total += entries
    bounds = first_run[torch.tensor([*edges, len(of_masks)], device=first_run.device)].tolist()
    return map(slice, bounds[:-1], bounds[1:])
