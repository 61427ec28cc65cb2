"""OpenGaussian: instance features without language, an instance codebook, CLIP vectors from associated masks.

1. Every Gaussian learns a unit vector of 6 numbers: rendered features are made similar inside each mask, and
   the means of a view's masks are pushed apart.
2. A coarse codebook groups Gaussians by feature and position; a fine codebook divides each group by feature.
3. A group (an instance) is assigned the CLIP vectors of the masks that fit it best in each view, by IoU times
   feature similarity. No language features are trained.

Source: Wu et al., OpenGaussian, NeurIPS 2024; yanmin-wu/OpenGaussian `train.py`. The constants below are the
authors'; they use `codebook` (64, 10), `steps` 10,000 and `rate` 0.001.

Departs:
    - each of our levels is processed separately; the authors use one level (wholes on LERF);
    - fewer steps and a larger rate; a step uses 4096 pixels of a view, and the exact means of its masks;
    - features are not trained further towards the codebooks (published: 10,000 and 20,000 steps);
    - positions are scaled to a standard deviation of 1 in the scene before the weight of 0.5;
    - Gaussians in no mask of the level keep their random features and belong to no instance;
    - Gaussians are never shrunk at random, and pixels with alpha below 0.5, not 0.7, are ignored;
    - the IoU of an instance and a mask uses visible weights instead of the instance rendered alone;
    - text queries use relevancy, as for all methods, not the best instance and up to ten similar instances.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.baselines import OpenGaussianSettings
from hilsplat.methods.common.groups import associated_codes, kmeans, standardised
from hilsplat.methods.common.training import product, segment_means, train, unit
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

CHANNELS = 6
SMOOTHING = 0.1
KMEANS_STEPS = 5
POSITION = 0.5
MIN_WEIGHT, HARD_WEIGHT = 0.1, 0.9
HARD_FROM = 0.5  # share of steps after which only the closest pairs keep their weight


def smoothing_loss(
    rendered: Float[Tensor, "p D"], means: Float[Tensor, "m D"], label: Int64[Tensor, " p"]
) -> Float[Tensor, ""]:
    """Return the mean distance of pixels from their mask's mean, averaged over masks that have pixels."""
    apart = (rendered - means[label]).square().sum(1, keepdim=True)
    distance, counts = segment_means((apart + 1e-12).sqrt(), label, len(means))
    return distance.sum() / (counts > 0).sum().clamp(min=1)


def contrast_loss(means: Float[Tensor, "m D"], done: float) -> Float[Tensor, ""]:
    """Return the mean of w / (squared distance + 1) over mask pairs, with w = 0.1 + 0.9 rank / (masks - 1).

    For each of the M masks, the others are ranked by distance: 1 for the farthest, M - 1 (w = 1) for the
    closest. After half of the steps, weights below 0.9 become 0.1.
    """
    num = len(means)
    if num < 2:
        return means.sum() * 0
    inverse = 1 / ((means[:, None] - means[None]).square().sum(2) + 1)
    others = inverse.masked_fill(torch.eye(num, dtype=torch.bool), -1.0)
    rank = others.detach().argsort(dim=1, stable=True).argsort(dim=1)  # own 0, farthest 1, closest num - 1
    weight = MIN_WEIGHT + (1 - MIN_WEIGHT) * rank / (num - 1)
    if done >= HARD_FROM:
        weight = torch.where(weight < HARD_WEIGHT, MIN_WEIGHT, weight)
    return (weight * others)[rank > 0].mean()


def instance_features(
    inputs: MethodInputs, settings: OpenGaussianSettings, seed: int
) -> Float32[np.ndarray, "N 3 D"]:
    """Return trained instance features of all levels: unit vectors mapped to [0, 1]."""
    views, contributions = labelled_views(inputs, settings.pixel_step), inputs.contributions
    num, levels = contributions.num_gaussians, len(LEVELS)
    start = np.random.default_rng(seed).random((num, levels, CHANNELS), dtype=np.float32)
    features = torch.from_numpy(start * 2 - 1).requires_grad_()
    A = contributions.matrix("A")
    means_of = {view.number: A[view.rows] for view in views}

    def loss(view: LabelledView, _: np.random.Generator, done: float) -> Tensor:
        colours = (unit(features).reshape(num, -1) + 1) / 2
        rendered = product(view.weights, colours).reshape(-1, levels, CHANNELS)
        means = product(means_of[view.number], colours).reshape(-1, levels, CHANNELS)
        level = contributions.level[view.rows]
        used = contributions.pixels[view.rows] > 0
        total = colours.sum() * 0
        for at_level in LEVELS:
            label = torch.from_numpy(view.labels[:, at_level.index].astype(np.int64))
            inside = label >= 0
            total = total + SMOOTHING * smoothing_loss(
                rendered[inside, at_level.index], means[:, at_level.index], label[inside]
            )
            masks = torch.from_numpy(np.flatnonzero((level == int(at_level)) & used))
            total = total + contrast_loss(means[masks, at_level.index], done)
        return total

    train(views, [features], loss, settings, seed)
    return ((unit(features.detach()) + 1) / 2).numpy()


def instances(
    features: Float32[np.ndarray, "N D"],
    means: Float32[np.ndarray, "N 3"],
    codebook: tuple[int, int],
    seed: int,
) -> Int64[np.ndarray, " N"]:
    """Return each Gaussian's group: coarse group times the number of fine groups, plus fine group.

    `codebook` contains the number of coarse groups and the number of fine groups in each coarse group.
    """
    num_coarse, num_fine = codebook
    placed = np.concatenate([features, np.float32(POSITION) * standardised(means)], axis=1)
    _, coarse = kmeans(placed, num_coarse, seed, KMEANS_STEPS)
    leaf = coarse * num_fine
    for group in range(num_coarse):
        inside = np.flatnonzero(coarse == group)
        leaf[inside] += kmeans(features[inside], num_fine, seed + group, KMEANS_STEPS)[1]
    return leaf


def fit(inputs: MethodInputs, settings: OpenGaussianSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train instance features, and assign each level's instances the codes of the masks that fit them.

    Gaussians get 0 if no mask fits their instance.
    """
    features, field = instance_features(inputs, settings, seed), inputs.no_features()
    contributions, visible, means = inputs.contributions, inputs.seen(), inputs.contributions.means()
    for level in LEVELS:
        of_level, rows = features[:, level.index], contributions.rows_of(level)
        gaussians = np.flatnonzero(visible[:, level.index])
        if len(gaussians):
            leaf = np.full(len(of_level), NONE, np.int64)
            leaf[gaussians] = instances(
                of_level[gaussians], means[gaussians], settings.codebook, seed + level.index
            )
            field[:, level.index] = associated_codes(inputs, leaf, rows, of_level)
    return field
