"""OmniSeg3D: features contrasted by the number of masks that patches share; thresholds set the granularity.

1. Masks of all levels divide a view into patches. Two patches share the masks that contain both: for nested
   masks, the number of shared masks is the depth of the deepest common ancestor in the coverage tree.
2. Every Gaussian learns one vector of 16 numbers: a rendered pixel is close to its own patch's prototype,
   less close to prototypes of patches that share masks with its patch, and far from the others.
3. Gaussians are clustered by cosine at three thresholds, one per level; a cluster is assigned the CLIP
   vectors of the masks that fit it best in each view.

Source: Ying et al., OmniSeg3D, CVPR 2024; OceanYing/OmniSeg3D-GS `train.py`. The constants below are the
authors' unless stated otherwise; they use `steps` 10,000 and `rate` 0.01.

Departs:
    - larger masks do not first absorb smaller ones; patches come from our painted masks;
    - fewer steps, each on 4096 (not 32,768) pixels of a view; prototypes of at least 3 (not 20) pixels;
    - initial vectors are almost identical instead of independent (see `training.initial_features`);
    - pixel vectors are divided by their length instead of constrained by a penalty of weight 100;
    - the authors threshold the cosine with a clicked pixel and don't support text: here 256 k-means centres
      are merged by average cosine down to the threshold.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32, Int64
from torch import Tensor
from torch.nn.functional import log_softmax

from hilsplat.base.levels import LEVELS
from hilsplat.baselines import OmniSeg3DSettings
from hilsplat.methods.common.groups import cluster_field, clusters
from hilsplat.methods.common.training import initial_features, product, segment_means, train, unit
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

CHANNELS = 16
MIN_PATCH_PX = 3
LEVEL_WEIGHT = 0.2  # factor on a patch's weight for each mask fewer that it shares
SPREAD, MIN_TEMPERATURE, MAX_TEMPERATURE = 10.0, 0.5, 1.0


def patches(labels: Int32[np.ndarray, "p 3"]) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, "k k"]]:
    """Return each pixel's patch (-1 in small patches), and the number of masks shared by each patch pair.

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
    """Return the pixel-to-prototype contrast, summed over numbers of shared masks.

    A pixel's loss is -log of the softmax over prototypes, weighted by 1 at the pixel's own patch and by 1/5
    (1/25) at patches that share one mask fewer (two fewer). The loss at each number of shared masks is at
    least the loss at the next larger number, so that patches that share more masks are closer. Patches
    without a shared mask are only negatives. Rendered features have unit length; `shared` is as in `patches`.
    """
    num = len(shared)
    prototypes, _ = segment_means(rendered, patch, num)
    apart = (rendered - prototypes[patch]).detach().norm(dim=1, keepdim=True)
    spread, _ = segment_means(apart, patch, num)
    temperature = (SPREAD * spread[:, 0]).clamp(MIN_TEMPERATURE, MAX_TEMPERATURE)
    surprise = -log_softmax(rendered @ unit(prototypes).T / temperature, dim=1)
    own_patch = surprise.gather(1, patch[:, None])
    total = own_patch.mean()
    missing = shared.diagonal()[:, None] - shared
    distance = missing.clamp(min=1).masked_fill(shared == 0, 0)
    distance.fill_diagonal_(0)
    floor = own_patch
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


def fit(inputs: MethodInputs, settings: OmniSeg3DSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train features, cluster them at three increasing cosines, and assign clusters the codes of masks."""
    views = labelled_views(inputs, settings.pixel_step)
    features = initial_features(inputs.contributions.num_gaussians, CHANNELS, seed)

    def loss(view: LabelledView, _: np.random.Generator, __: float) -> Tensor:
        patch, shared = patches(view.labels)
        inside = np.flatnonzero(patch >= 0)
        if len(shared) < 2:
            return features.sum() * 0
        rendered = unit(product(view.weights[inside], unit(features)))
        return hierarchical_loss(rendered, torch.from_numpy(patch[inside]), torch.from_numpy(shared))

    train(views, [features], loss, settings, seed)
    distances = tuple(1 - cosine for cosine in settings.thresholds)
    return cluster_field(inputs, clusters(unit(features.detach()).numpy(), distances, seed, "cosine"))
