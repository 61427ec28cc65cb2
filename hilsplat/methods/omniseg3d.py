"""OmniSeg3D: features contrasted by how many masks two patches of a view share; thresholds give granularity.

1. Masks of all levels cut a view into patches. Two patches share the masks that hold both: where masks nest,
   that is the depth of their deepest common ancestor in the coverage tree.
2. Every Gaussian learns one vector of 16 numbers: a rendered pixel is near the prototype of its own patch,
   less near those of patches that share masks with it, and far from the others.
3. Gaussians are clustered by cosine at three thresholds, one per level; a cluster takes the CLIP vectors of
   the masks that fit it best in each view.

Source: Ying et al., OmniSeg3D, CVPR 2024; OceanYing/OmniSeg3D-GS `train.py`. Authors' values are in the
constants, and `steps` 10,000, `rate` 0.01.

Departs:
    - a larger mask does not first absorb smaller ones; patches are those of our painted masks;
    - fewer steps, on 4096 pixels of a view in place of 32,768, and prototypes of at least 3 in place of 20;
    - vectors start almost alike, not independent of each other (`training.alike` says why);
    - vectors of pixels have length 1 by division, not by a penalty of weight 100;
    - the authors threshold the cosine with a clicked pixel and know no text: here 256 k-means centres are
      joined by average cosine down to the threshold.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor
from torch.nn.functional import log_softmax

from hilsplat.base.levels import LEVELS
from hilsplat.methods.common.groups import cluster_field, clusters, thresholds_of
from hilsplat.methods.common.pixels import LabelledView, labelled_views
from hilsplat.methods.common.training import alike, product, segment_means, train, unit
from hilsplat.methods.method import Method, MethodInputs
from hilsplat.settings import MethodSettings

CHANNELS = 16
MIN_PATCH_PX = 3
LEVEL_WEIGHT = 0.2
"""Weight of a level of sharing, relative to the one before: a fifth."""
SPREAD, LEAST_TEMPERATURE, MOST_TEMPERATURE = 10.0, 0.5, 1.0
THRESHOLDS = (0.5, 0.8, 0.95)


def patches(labels: Int32[np.ndarray, "p 3"]) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, "k k"]]:
    """Patch of each pixel, -1 in patches of few pixels, and how many masks every two patches share.

    Example:
        >>> patches(np.array([[0, 1, -1]] * 3 + [[0, 2, -1]] * 3, dtype=np.int32))[1]
        array([[2, 1],
               [1, 2]])
    """
    kinds, patch, counts = np.unique(labels, axis=0, return_inverse=True, return_counts=True)
    large = np.flatnonzero(counts >= MIN_PATCH_PX)
    renumber = np.full(len(kinds), -1, np.int64)
    renumber[large] = np.arange(len(large))
    kinds = kinds[large]
    shared = ((kinds[:, None] == kinds[None]) & (kinds >= 0)[None]).sum(axis=2)
    return renumber[patch.reshape(-1)], shared


def hierarchical_loss(
    rendered: Float[Tensor, "p D"], patch: Int64[Tensor, " p"], shared: Int64[Tensor, "k k"]
) -> Float[Tensor, ""]:
    """Contrast of pixels with prototypes of patches, level of sharing by level.

    A pixel's loss is -log of the softmax over prototypes. At its own patch it counts fully; at patches that
    share one mask less (two less) it counts a fifth (a 25th), and there it is never below the loss at the
    level before, so that nearer patches come first. Patches that share no mask are negatives only.

    Args:
        rendered: unit features of pixels.
        patch: of each pixel.
        shared: number of masks that two patches share.
    """
    num = len(shared)
    prototypes, _ = segment_means(rendered, patch, num)
    apart = (rendered - prototypes[patch]).detach().norm(dim=1, keepdim=True)
    spread, _ = segment_means(apart, patch, num)
    temperature = (SPREAD * spread[:, 0]).clamp(LEAST_TEMPERATURE, MOST_TEMPERATURE)
    surprise = -log_softmax(rendered @ unit(prototypes).T / temperature, dim=1)
    own = surprise.gather(1, patch[:, None])
    total = own.mean()
    missing = shared.diagonal()[:, None] - shared
    distance = missing.clamp(min=1).masked_fill(shared == 0, 0)
    distance.fill_diagonal_(0)
    floor = own
    for step in range(1, len(LEVELS)):
        near = (distance == step)[patch]
        has = near.any(dim=1)
        if not has.any():
            continue
        raised = torch.maximum(surprise, floor) * near
        loss = raised.sum(1, keepdim=True) / near.sum(1, keepdim=True).clamp(min=1)
        total = total + LEVEL_WEIGHT**step * loss[has].mean()
        floor = torch.where(has[:, None], loss, floor)
    return total


def train_features(
    views: list[LabelledView], num_gaussians: int, settings: MethodSettings, seed: int
) -> Float32[np.ndarray, "N D"]:
    """Train the features of Gaussians, of unit length."""
    features = alike(num_gaussians, CHANNELS, seed)

    def loss(view: LabelledView, _: np.random.Generator, __: float) -> Tensor:
        patch, shared = patches(view.labels)
        inside = np.flatnonzero(patch >= 0)
        if len(shared) < 2:
            return features.sum() * 0
        rendered = unit(product(view.weights[inside], unit(features)))
        return hierarchical_loss(rendered, torch.from_numpy(patch[inside]), torch.from_numpy(shared))

    train(views, [{"params": [features], "lr": settings.rate}], loss, settings, seed)
    return unit(features.detach()).numpy()


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train features, cluster them at three thresholds, and give the clusters the codes of masks.

    Raises:
        SettingsError: the thresholds do not grow.
    """
    thresholds = thresholds_of(settings, THRESHOLDS)
    views = labelled_views(inputs, settings.pixel_step)
    features = train_features(views, inputs.contributions.num_gaussians, settings, seed)
    return cluster_field(inputs, clusters(features, thresholds, seed))


METHOD = Method(
    "omniseg3d",
    "OmniSeg3D",
    "OceanYing/OmniSeg3D-GS train.py; departs: patches of painted masks, fewer steps on 4096 pixels, "
    "unit length by division, clusters at three thresholds of the cosine in place of a click, CLIP of the "
    "masks that fit a cluster",
    fit,
)
