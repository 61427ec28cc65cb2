"""LaGa: contrastive features nested by prefix; objects from all views' masks, with several descriptors each.

1. Every Gaussian learns 32 numbers: wholes use the first 16, parts the first 24, and subparts all. Pixels are
   attracted to their mask's prototype and repelled from others. Pixels that share a finer mask must agree
   in the coarser prefix; pixels that a coarser mask separates must differ in the finer prefix.
2. Mask prototypes from all views are clustered by density to objects; a Gaussian joins the nearest object.
3. The CLIP vectors of an object's masks are clustered; the silhouette determines the number of descriptors,
   up to 20. A descriptor's weight is its cosine with the object's average.

Source: Cen et al., LaGa, ICML 2025; SJTU-DeepVisionLab/LaGa `train_affinity_features.py`, `inference.ipynb`.
The constants below are the authors'; they use `steps` 30,000 and `rate` 0.0025.

Departs:
    - an object's descriptors are combined in a weighted sum, because a field here has one code per Gaussian
      and level; the authors take, for each query, the maximum of relevancy times weight;
    - levels are queried separately; the authors average the three scores and smooth them over neighbours;
    - DBSCAN* clusters at the authors' radius; they use it as the minimum radius of HDBSCAN clusters;
    - one k-means start per number of descriptors instead of ten;
    - masks are painted; fewer steps, each on 2048 pixels of a view; almost identical initial features; object
      prototypes from exact mask means; masks below the authors' minimum share of the image are ignored.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from scipy.spatial.distance import cdist
from torch import Tensor

from hilsplat.base.levels import LEVELS, NONE
from hilsplat.baselines import TrainedSettings
from hilsplat.field.code import LinearCode, unit_rows
from hilsplat.methods.common.groups import density_clusters, features_of_groups, group_means, kmeans
from hilsplat.methods.common.training import initial_features, nonempty_columns, product, train, unit
from hilsplat.methods.langsplat_v2 import as_vectors
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

SLICES = (16, 8, 8)
PREFIX = (16, 24, 32)
MIN_SHARE = 400 / (988 * 731)  # minimum share of the image that a mask covers: 400 px in a LERF view
SAME_IOU = 0.8
HARD_COSINE = 0.5
RADIUS = (0.3, 0.2, 0.1)  # radius of density clusters for wholes, parts, subparts
MIN_MASKS = 5  # minimum number of masks within a dense mask's radius, limited to the number of views
MAX_DESCRIPTORS = 20
PIXELS = 2048


def unit_slices(features: Float[Tensor, "n 32"]) -> Float[Tensor, "n 32"]:
    return torch.cat([unit(part) for part in features.split(SLICES, 1)], 1)


def masks_of_pixels(labels: Int32[np.ndarray, "p 3"]) -> list[Bool[np.ndarray, "p _"]]:
    """Return the pixels of each level's usable masks: large enough, and not a duplicate of a finer mask."""
    min_pixels = max(MIN_SHARE * len(labels), 1)
    every, usable = [label[:, None] == np.unique(label[label >= 0]) for label in labels.T], []
    for index, inside in enumerate(every):
        keep = large = inside.sum(axis=0) > min_pixels
        for finer in every[index + 1 :]:
            shared = inside.T.astype(np.float32) @ finer.astype(np.float32)
            union = inside.sum(axis=0)[:, None] + finer.sum(axis=0)[None] - shared
            keep = keep & (np.max(shared / union, axis=1, initial=0) < SAME_IOU)
        usable.append(inside[:, keep if keep.any() else large])
    return usable


def nested_loss(
    rendered: Float[Tensor, "p 32"], masks: list[Bool[np.ndarray, "p _"]], random: np.random.Generator
) -> Float[Tensor, ""]:
    """Return the pixel-to-prototype contrast per prefix, plus a penalty on slice lengths other than 1.

    `masks` contains the pixels of each mask, level by level. Outside a mask, all hard pixels are
    used, plus as many random pixels as there are pixels inside.
    """
    inside = [torch.from_numpy(pixels) for pixels in masks]
    last = len(LEVELS) - 1

    def cosine(level: int, prefix: int) -> Tensor:
        features = rendered[:, : PREFIX[prefix]]
        return unit(features) @ unit(inside[level].T.to(features.dtype) @ features).T

    lengths = torch.stack([part.norm(dim=1).mean() for part in rendered.split(SLICES, 1)])
    total = (1 - lengths.mean()).square()
    for level, pixels_inside in enumerate(inside):
        if not pixels_inside.shape[1]:
            continue
        similarity = near = far = cosine(level, level)
        if level > 0:
            near = torch.minimum(near, cosine(level, level - 1))
        if level < last:
            far = torch.maximum(far, cosine(level, level + 1))
        outside = ~pixels_inside
        share = pixels_inside.sum(0) / outside.sum(0).clamp(min=1)
        drawn = torch.from_numpy(random.random(pixels_inside.shape, dtype=np.float32)) < share
        negative = outside & (drawn | (similarity.detach() > HARD_COSINE))
        total = total - (near * pixels_inside).sum() / pixels_inside.sum()
        total = total + (far.relu() * negative).sum() / negative.sum().clamp(min=1)
    return total


def objects(
    features: Float32[np.ndarray, "N C"],
    prototypes: Float32[np.ndarray, "m C"],
    radius: float,
    min_masks: int,
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " m"]]:
    """Return the object (a density cluster of prototypes) of each Gaussian and each mask, -1 for none.

    Features and prototypes have unit length; `radius` and `min_masks` are as in `density_clusters`.
    """
    of_mask = density_clusters(prototypes, radius, min_masks)
    has = of_mask != NONE
    if not has.any():
        return np.full(len(features), NONE, np.int64), of_mask
    centres = np.zeros((of_mask.max() + 1, prototypes.shape[1]), np.float32)
    np.add.at(centres, of_mask[has], prototypes[has])
    return (features @ unit_rows(centres).T).argmax(axis=1).astype(np.int64), of_mask


def silhouette(distance: Float[np.ndarray, "n n"], group: Int64[np.ndarray, " n"]) -> float:
    """Return the mean silhouette (Rousseeuw 1987); the only row of a group counts as 0."""
    counts = np.bincount(group)
    to_group = distance @ np.eye(len(counts))[group]
    rows = np.arange(len(group))
    a = to_group[rows, group] / np.maximum(counts[group] - 1, 1)
    to_group = to_group / np.maximum(counts, 1)
    to_group[rows, group] = np.inf
    to_group[:, counts == 0] = np.inf
    b = to_group.min(axis=1)
    return float(np.where(counts[group] > 1, (b - a) / np.maximum(np.maximum(a, b), 1e-12), 0).mean())


def descriptor_weights(vectors: Float32[np.ndarray, "n C"], seed: int) -> Float[np.ndarray, " n"]:
    """Return the weight of each mask's vector in the weighted sum of its object's descriptors.

    A descriptor is the unit centroid c of a cluster of vectors. Its weight is c.a, where a is the unit
    average of all vectors, so that scattered clusters have less weight. Vectors have unit length.
    """
    group, best = np.zeros(len(vectors), np.int64), -1.0
    distance = cdist(vectors, vectors)
    for count in range(2, min(MAX_DESCRIPTORS, len(vectors) - 1) + 1):
        _, tried = kmeans(vectors, count, seed)
        if len(np.unique(tried)) == count and (score := silhouette(distance, tried)) > best:
            group, best = tried, score
    centroids, size = group_means(vectors, group, int(group.max()) + 1)
    average = vectors.mean(axis=0) / np.maximum(np.linalg.norm(vectors.mean(axis=0)), 1e-12)
    weight = centroids @ average / np.maximum(np.linalg.norm(centroids, axis=1), 1e-12)
    return (weight / size)[group]


def object_latents(
    of_mask: Int64[np.ndarray, " m"], latents: Float32[np.ndarray, "m D"], code: LinearCode, seed: int
) -> Float32[np.ndarray, "T D"]:
    """Return the code of the weighted sum of each object's descriptors.

    A weighted sum of vectors m + U z has the direction of the vector whose z is the weighted average of z.
    """
    vectors = as_vectors(latents, code)
    length = np.linalg.norm(vectors, axis=1)
    codes = np.zeros((int(of_mask.max(initial=NONE)) + 1, latents.shape[1]), np.float32)
    for number in range(len(codes)):
        members = np.flatnonzero(of_mask == number)
        weight = descriptor_weights(vectors[members] / length[members, None], seed) / length[members]
        if weight.sum() > 0:
            codes[number] = weight @ latents[members] / weight.sum()
    return codes


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train features, find objects at each level, and assign each object the code of its descriptors."""
    contributions, code = inputs.contributions, inputs.linear_code("laga")
    views, field = labelled_views(inputs, settings.pixel_step), inputs.no_features()
    trained = initial_features(contributions.num_gaussians, sum(SLICES), seed)

    def loss(view: LabelledView, random: np.random.Generator, _: float) -> Tensor:
        weights, gaussians = nonempty_columns(view.weights)
        rendered = product(weights, unit_slices(trained[gaussians]))
        return nested_loss(rendered, masks_of_pixels(view.labels), random)

    train(views, [trained], loss, settings, seed, PIXELS)
    features = unit_slices(trained.detach()).numpy()
    A, min_masks = contributions.matrix("A"), min(MIN_MASKS, len(contributions.views))
    image_px = np.array([np.prod(inputs.view_camera(view).size_hw) for view in contributions.views])
    large = (contributions.pixels > 0) & (contributions.area_px > MIN_SHARE * image_px[contributions.view])
    for level in LEVELS:
        rows = contributions.rows_of(level)
        rows = rows[large[rows]]
        prefix = slice(PREFIX[level.index])
        prototypes_of_masks = unit_slices(torch.from_numpy(A[rows] @ features)).numpy()[:, prefix]
        points, prototypes = unit_rows(features[:, prefix]), unit_rows(prototypes_of_masks)
        group, of_mask = objects(points, prototypes, RADIUS[level.index], min_masks)
        latents = object_latents(of_mask, inputs.latents[rows], code, seed)
        field[:, level.index] = features_of_groups(group, latents)
    return field
