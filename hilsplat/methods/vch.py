"""View-consistent hierarchy: features whose ultrametric reproduces the coverage trees of the views.

1. Every Gaussian learns a vector. Pixels are joined to their 10 nearest pixels by edges whose length is
   their vectors' distance; the ultrametric is the longest edge on a pair's minimum spanning tree path.
2. For every mask, a pixel inside must be closer to other pixels inside than to pixels outside that are in the
   mask's parent, by dot product and by ultrametric.
3. Gaussians are connected to those of their 16 nearest neighbours within a given feature distance; nested
   components at three distances form the levels. A component gets its best mask's CLIP vector in each view.

Source: He et al., View-Consistent Hierarchical 3D Segmentation Using Ultrametric Feature Fields, CVPR 2024;
hardyho/ultrametric_feature_fields. The constants below are the authors'; they use 20 epochs and `rate` 0.01.

Departs:
    - vectors of 16 numbers on frozen Gaussians, not an instant-NGP field of 128 with its own density;
    - unit length by division, without a penalty on the norm; depth is not smoothed;
    - parents are those of our coverage tree; the authors require 0.95 of a mask and an IoU below 0.9;
    - components consist of Gaussians, not of 0.002 voxels; all but the 200 largest join the nearest of these;
    - the authors don't support text.
"""

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Float32, Int32, Int64
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import softplus

from hilsplat.base.levels import NONE
from hilsplat.baselines import VchSettings
from hilsplat.field.contrast import read_parents
from hilsplat.methods.common.groups import cluster_field, nearest
from hilsplat.methods.common.training import initial_features, product, train, unit
from hilsplat.methods.kernels import joining_edges
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

CHANNELS = 16
TEMPERATURE = 0.1
PAIRS = 64  # triplets per mask and step
PIXEL_NEIGHBOURS = 10
BORDER = 10.0  # added to edges across mask borders, per level, when the spanning tree is chosen
NEIGHBOURS = 16
MAX_COMPONENTS = 200


def ultrametric(
    vectors: Float[Tensor, "p D"],
    edges: Int64[np.ndarray, "2 e"],
    penalty: Float[np.ndarray, " e"],
    pairs: Int64[np.ndarray, "2 k"],
) -> Float[Tensor, " k"]:
    """Return the longest edge on each pixel pair's path in the minimum spanning tree; differentiable.

    The penalty is added to edge lengths when the tree is chosen, not in the result. The result is 2 for a
    pair without a path, and 0 for a pixel and itself.
    """
    num = len(vectors)
    values = vectors.detach().numpy()
    length = np.sqrt(np.square(values[edges[0]] - values[edges[1]]).sum(axis=1))
    graph = sp.csr_matrix((length + penalty + 1e-6, (edges[0], edges[1])), shape=(num, num))  # 0 is no edge
    tree = minimum_spanning_tree(graph).tocoo()
    a, b = tree.row.astype(np.int64), tree.col.astype(np.int64)
    order = np.argsort(np.square(values[a] - values[b]).sum(axis=1), kind="stable")
    a, b = a[order], b[order]
    edge = joining_edges(num, a, b, pairs[0], pairs[1])
    has_path = torch.from_numpy(edge >= 0)
    edge = np.maximum(edge, 0)
    apart = torch.from_numpy(np.where(pairs[0] == pairs[1], 0.0, 2.0).astype(values.dtype))
    if not len(a):
        return apart
    distance = ((vectors[a[edge]] - vectors[b[edge]]).square().sum(1) + 1e-12).sqrt()
    return torch.where(has_path, distance, apart)


def neighbouring_pixels(xy: Int64[np.ndarray, "p 2"]) -> Int64[np.ndarray, "2 e"]:
    """Return the distinct edges from each pixel to its nearest pixels in the image."""
    near = nearest(xy, PIXEL_NEIGHBOURS + 1)
    edges = np.stack([np.repeat(np.arange(len(xy)), near.shape[1]), near.ravel()])
    return np.unique(np.sort(edges[:, edges[0] != edges[1]], axis=0), axis=1)


def triplets(
    labels: Int32[np.ndarray, "p 3"],
    level: np.ndarray,
    parent: Int32[np.ndarray, " m"],
    random: np.random.Generator,
) -> Int64[np.ndarray, "3 k"]:
    """For each mask, draw `PAIRS` pixels a, b inside, and c outside but in the parent (a root: anywhere).

    `labels` contains the mask row at each pixel and level; `parent` contains each mask's parent row, or -1.
    """
    drawn = []
    for mask in np.unique(labels[labels >= 0]):
        inside = labels[:, level[mask] - 1] == mask
        above = parent[mask]
        around = np.ones(len(labels), bool) if above == NONE else labels[:, level[above] - 1] == above
        inner, outer = np.flatnonzero(inside), np.flatnonzero(around & ~inside)
        if len(inner) > 1 and len(outer):
            drawn.append(np.stack([random.choice(pixels, PAIRS) for pixels in (inner, inner, outer)]))
    return np.concatenate(drawn, axis=1) if drawn else np.zeros((3, 0), np.int64)


def components(
    features: Float32[np.ndarray, "N D"],
    means: Float32[np.ndarray, "N 3"],
    thresholds: tuple[float, float, float],
) -> Int64[np.ndarray, "N 3"]:
    """Return each Gaussian's component at every distance, numbered from the largest component.

    Gaussians outside the 200 largest components join the component of the nearest Gaussian in one of these.
    """
    num = len(means)
    near = nearest(means, NEIGHBOURS + 1)
    a, b = np.repeat(np.arange(num), near.shape[1]), near.ravel()
    apart = np.sqrt(np.square(features[a] - features[b]).sum(axis=1))
    ranks = []
    for threshold in thresholds:
        joined = apart < threshold
        graph = sp.csr_matrix((np.ones(joined.sum()), (a[joined], b[joined])), shape=(num, num))
        number, part = connected_components(graph, directed=False)
        order = np.argsort(-np.bincount(part, minlength=number), kind="stable")
        rank = np.argsort(order)[part]
        large, small = np.flatnonzero(rank < MAX_COMPONENTS), np.flatnonzero(rank >= MAX_COMPONENTS)
        rank[small] = rank[large[cKDTree(means[large]).query(means[small])[1]]]
        ranks.append(rank)
    return np.stack(ranks, axis=1)


def fit(inputs: MethodInputs, settings: VchSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Train vectors, connect Gaussians at decreasing distances, and assign components the codes of masks."""
    contributions = inputs.contributions
    views = labelled_views(inputs, settings.pixel_step)
    parents = read_parents(inputs.coverage_tree_folder, contributions)
    features = initial_features(contributions.num_gaussians, CHANNELS, seed)

    def loss(view: LabelledView, random: np.random.Generator, _: float) -> Tensor:
        parent = parents[contributions.views[view.number]]
        a, b, c = chosen = triplets(view.labels, contributions.level[view.rows], parent, random)
        if not chosen.shape[1]:
            return features.sum() * 0
        vectors = unit(product(view.weights, unit(features)))
        edges = neighbouring_pixels(view.xy)
        borders = (view.labels[edges[0]] != view.labels[edges[1]]).sum(axis=1)
        pairs = np.concatenate([chosen[[0, 1]], chosen[[0, 2]]], axis=1)
        near, far = ultrametric(vectors, edges, BORDER * borders, pairs).chunk(2)
        dots = (vectors[a] * (vectors[c] - vectors[b])).sum(1)
        # -log of the softmax of the pair inside the mask versus the pair across its border
        return softplus(dots / TEMPERATURE).mean() + softplus((near - far) / TEMPERATURE).mean()

    train(views, [features], loss, settings, seed)
    trained = unit(features.detach()).numpy()
    return cluster_field(inputs, components(trained, contributions.means(), settings.thresholds))
