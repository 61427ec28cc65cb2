"""SAGA: Gaussians with affinity features that a gate adapts to a scale (GARField's idea for Gaussians).

1. Every mask has a 3D scale. Every Gaussian learns 32 numbers, averaged over its neighbours and multiplied by
   a gate that depends on the scale: two pixels can be grouped at a large scale and separate at a small scale.
2. At a scale, two pixels belong together if they share a mask up to that scale, or if the smallest mask
   above that scale is the same for both.
3. Features gated at the median scale of a level's masks are clustered; clusters get fitting CLIP vectors.

Source: Cen et al., Segment Any 3D Gaussians, AAAI 2025; Jumpat/SegAnyGAussians `get_scale.py`,
`train_contrastive_feature.py`; scales and their quantiles from GARField (Kim et al., CVPR 2024,
chungmin99/garfield). The constants below are the authors'; they use `steps` 10,000 and `rate` 0.0025.

Departs:
    - a mask's scale is the spread of its Gaussians, not of unprojected depths;
    - masks are painted, at most three per pixel; fewer steps, each on 256 pixels of a view, not 1000;
    - almost identical initial features; all 16 neighbours are used at every step;
    - the authors click at a chosen scale or cluster by HDBSCAN, and don't support text: here the scales are
      the levels' medians, 256 k-means centres are merged by average cosine as for OmniSeg3D, and clusters
      get CLIP vectors by association.
"""

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int32
from torch import Tensor

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.baselines import TrainedSettings
from hilsplat.contributions.rows import Contributions
from hilsplat.methods.common.groups import cluster_field, clusters, nearest
from hilsplat.methods.common.training import initial_features, nonempty_columns, product, train, unit
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

CHANNELS = 32
NEIGHBOURS = 16
SCALES = 8  # random scales per step, plus one below and one above all masks of the view
PIXELS = 256
MAX_WEIGHT = 10.0
EASY_POSITIVE, HARD_NEGATIVE = 0.75, 0.5
COSINE = 0.95  # minimum average in a cluster; 0.5 doesn't separate parts and subparts in development scenes


def mask_scales(contributions: Contributions) -> Float64[np.ndarray, " M"]:
    """Return twice the standard deviation of Gaussian positions in each mask, scene units; 0 if none."""
    A = contributions.matrix("A").astype(np.float64)
    means = contributions.means().astype(np.float64)
    means -= means.mean(axis=0)
    variance = A @ np.square(means).sum(axis=1) - np.square(A @ means).sum(axis=1)
    return 2 * np.sqrt(np.maximum(variance, 0))


def drawn_scales(scales: Float64[np.ndarray, " m"], random: np.random.Generator) -> Float64[np.ndarray, " s"]:
    """Draw scales between a view's adjacent mask scales, plus one below and one above all mask scales."""
    ends = np.concatenate([[0.0], np.sort(scales), [2 * scales.max()]])
    between = 1 + random.permutation(len(scales) - 1)[:SCALES]
    chosen = np.concatenate([[0], between, [len(ends) - 2]])
    return ends[chosen] + (ends[chosen + 1] - ends[chosen]) * random.random(len(chosen))


def grouped_at(
    labels: Int32[np.ndarray, "p 3"], scales: Float64[np.ndarray, "p 3"], scale: float
) -> Bool[np.ndarray, "p p"]:
    """Return whether two pixels share a mask at or below the scale, or the smallest mask above the scale.

    `labels` contains each pixel's mask at each level (-1: none; a mask has one level), `scales` its scale.
    """
    above = (labels >= 0) & (scales > scale)
    smallest = np.where(above, scales, np.inf).argmin(axis=1)
    groups = np.where(above & (np.arange(labels.shape[1]) != smallest[:, None]), -1, labels)
    return ((groups[:, None] == groups[None]) & (groups >= 0)[None]).any(axis=2)


def pair_weights(area_px: Float64[np.ndarray, " p"]) -> Float32[np.ndarray, "p p"]:
    """Return the weight of each pair of pixels, from 1 to 10; pixels of small masks have more weight."""
    pairs = np.outer(area_px, area_px)
    weight = pairs.max() / np.maximum(pairs, 1e-12)
    low, high = weight.min(), weight.max()
    return (1 + (MAX_WEIGHT - 1) * (weight - low) / max(high - low, 1e-12)).astype(np.float32)


def affinity_loss(
    rendered: Float[Tensor, "p 32"],
    gates: Float[Tensor, "s 32"],  # of each scale
    same: Bool[np.ndarray, "s p p"],  # whether two pixels are together at each scale
    weight: Float32[np.ndarray, "p p"],  # of each pair
    random: np.random.Generator,
) -> Float[Tensor, ""]:
    """Return a loss that raises cosines in groups and lowers positive ones between them; lengths stay near 1.

    It uses pairs whose grouping depends on the scale, pairs hard at some scale, and as many easy pairs.
    """
    gated = unit(rendered[None] * gates[:, None])
    cosine = gated @ gated.transpose(1, 2)
    grouped = torch.from_numpy(same)
    never, always = ~grouped.any(0), grouped.all(0)
    mixed = ~(never | always)
    easy = mixed.sum() / 2
    draw = torch.from_numpy(random.random(mixed.shape, dtype=np.float32))
    pair = torch.ones_like(mixed).triu(1)
    values = cosine.detach()
    positive = mixed | (always & (draw < easy / always.sum().clamp(min=1)))
    positive = (positive | (grouped & (values < EASY_POSITIVE)).any(0)) & pair
    negative = mixed | (never & (draw < easy / never.sum().clamp(min=1)))
    negative = (negative | (~grouped & (values > HARD_NEGATIVE)).any(0)) & pair
    weights = torch.from_numpy(weight)
    total = (1 - rendered.norm(dim=1).mean()).square()
    attract = weights * (positive & grouped) / (len(gates) * positive.sum().clamp(min=1))
    repel = weights * (negative & ~grouped) / (len(gates) * negative.sum().clamp(min=1))
    return total + (repel * cosine.relu() - attract * cosine).sum()


def neighbour_mean(means: Float32[np.ndarray, "N 3"]) -> sp.csr_matrix:
    """Return the matrix that averages over each Gaussian and its nearest neighbours, 16 in total."""
    near = nearest(means, NEIGHBOURS)
    num, count = near.shape
    data = np.full(near.size, 1 / count, np.float32)
    return sp.csr_matrix((data, (np.repeat(np.arange(num), count), near.ravel())), shape=(num, num))


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train features, cluster them at each level's median scale, and assign clusters the codes of masks."""
    contributions = inputs.contributions
    scales = mask_scales(contributions)
    views = labelled_views(inputs, settings.pixel_step)
    features = initial_features(contributions.num_gaussians, CHANNELS, seed)
    draw = torch.Generator().manual_seed(seed)
    gate = (2 * torch.rand(2, CHANNELS, generator=draw) - 1).requires_grad_()  # slope and offset
    smooth = neighbour_mean(contributions.means())
    quantile = np.linspace(0, 1, len(scales)), np.sort(scales)

    def gates(at: Float64[np.ndarray, " s"]) -> Tensor:
        share = torch.from_numpy(np.interp(at, quantile[1], quantile[0]).astype(np.float32))
        return (share[:, None] * gate[0] + gate[1]).sigmoid()

    def loss(view: LabelledView, random: np.random.Generator, _: float) -> Tensor:
        rows, has = view.rows, view.labels >= 0
        scale = np.where(has, scales[rows][view.labels], 0)
        area = np.where(has, contributions.area_px[rows][view.labels], 0).sum(axis=1) / has.sum(axis=1)
        at = drawn_scales(scales[rows], random)
        same = np.stack([grouped_at(view.labels, scale, scale_limit) for scale_limit in at])
        weights, gaussians = nonempty_columns(view.weights @ smooth)
        rendered = product(weights, unit(features[gaussians]))
        return affinity_loss(rendered, gates(at), same, pair_weights(area), random)

    train(views, [features, gate], loss, settings, seed, PIXELS)
    levels = [level for level in LEVELS if len(contributions.rows_of(level))]
    medians = np.array([np.median(scales[contributions.rows_of(level)]) for level in levels])
    with torch.no_grad():
        gated = unit(product(smooth, unit(features))[None] * gates(medians)[:, None]).numpy()
    group = np.full((contributions.num_gaussians, len(LEVELS)), NONE, np.int64)
    for level, of_level in zip(levels, gated, strict=True):
        group[:, level.index] = clusters(of_level, (1 - COSINE,), seed, "cosine")[:, 0]
    return cluster_field(inputs, group)
