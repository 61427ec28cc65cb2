"""Gaussian Grouping: identity codes with a linear classifier, smooth in 3D; each identity has a CLIP vector.

1. Masks of the same object in all views get one identity.
2. Every Gaussian learns a code of 16 numbers. A linear classifier predicts the identity of each rendered
   pixel (cross-entropy); a Gaussian and its 5 nearest neighbours get similar class probabilities (KL).
3. A Gaussian gets its most probable identity, and the mean CLIP vector of that identity's masks.

Source: Ye et al., Gaussian Grouping, ECCV 2024; lkeab/gaussian-grouping `train.py`, `utils/loss_utils.py`.
The constants below are the authors'; they use `steps` 30,000 and `rate` 0.0025 (classifier: 0.0005).

Departs:
    - identities come from masks linked by shared Gaussians, as in our tree, not from a video tracker (DEVA),
      so that a table row shows the effect of the codes and the classifier;
    - each level is trained separately; the authors use one set of masks;
    - pixels without an identity are ignored; the authors assign them a separate class;
    - geometry is frozen instead of trained together with the codes;
    - fewer steps, each on 4096 pixels of a view; classifier and codes share a learning rate;
    - the KL is computed at every step instead of every fifth, with 1000 samples as in the original;
    - text queries use the identities' CLIP vectors, not Grounding-DINO and SAM in the first view.
"""

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor
from torch.nn.functional import cross_entropy, log_softmax

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.baselines import TrainedSettings
from hilsplat.contributions.rows import Contributions
from hilsplat.methods.common.groups import features_of_groups, group_means, nearest
from hilsplat.methods.common.training import one_torch_thread, product, train
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views
from hilsplat.semantic_tree.nodes import linked_nodes
from hilsplat.settings import SemanticTreeSettings

CHANNELS = 16
SMOOTHING = 2.0
NEIGHBOURS = 5
SAMPLES = 1000


def mask_identities(contributions: Contributions, threads: int) -> Int64[np.ndarray, " M"]:
    """Return each mask's identity at its level, by our default linking via shared Gaussians; -1 for none."""
    S, mass = contributions.matrix("S"), contributions.matrix("mass")
    settings = SemanticTreeSettings()
    settings = settings.model_copy(update={"min_views": min(settings.min_views, mass.shape[0])})
    rows_of_levels = [contributions.rows_of(level) for level in LEVELS]
    identity = np.full(len(contributions), NONE, np.int64)
    of_levels = linked_nodes(S, mass, contributions.view, rows_of_levels, settings, threads)
    for rows, nodes in zip(rows_of_levels, of_levels, strict=True):
        identity[rows] = nodes.of_mask
    return identity


def neighbour_loss(
    logits: Float[Tensor, "s K"], others: Float[Tensor, "s n K"], num_classes: int
) -> Float[Tensor, ""]:
    """Return the mean KL divergence from the neighbours' class probabilities, divided by the class count."""
    log_p, log_q = log_softmax(logits, -1)[:, None], log_softmax(others, -1)
    return (log_p.exp() * (log_p - log_q)).sum(-1).mean() / num_classes


def identity_of_gaussians(
    views: list[LabelledView],
    contributions: Contributions,
    identity: Int64[np.ndarray, " M"],  # of every mask of the scene, -1 for none or at other levels
    level: Level,
    settings: TrainedSettings,
    seed: int,
) -> Int64[np.ndarray, " N"]:
    """Train the codes and the classifier of a level, and classify the Gaussians."""
    num_classes = int(identity.max()) + 1
    draw = torch.Generator().manual_seed(seed)
    codes = (0.1 * torch.randn(contributions.num_gaussians, CHANNELS, generator=draw)).requires_grad_()
    classifier = (torch.randn(CHANNELS, num_classes, generator=draw) / CHANNELS**0.5).requires_grad_()
    neighbours = nearest(contributions.means(), NEIGHBOURS + 1)[:, 1:]

    def loss(view: LabelledView, random: np.random.Generator, _: float) -> Tensor:
        of_label = np.append(identity[view.rows], NONE)
        target = torch.from_numpy(of_label[view.labels[:, level.index]])
        logits = product(view.weights, codes)[target >= 0] @ classifier
        total = classifier.sum() * 0
        if len(logits):
            total = cross_entropy(logits, target[target >= 0]) / max(np.log(num_classes), 1e-9)
        if neighbours.shape[1]:
            chosen = random.integers(len(neighbours), size=min(SAMPLES, len(neighbours)))
            apart = neighbour_loss(
                codes[chosen] @ classifier, codes[neighbours[chosen]] @ classifier, num_classes
            )
            total = total + SMOOTHING * apart
        return total

    if num_classes > 1:
        train(views, [codes, classifier], loss, settings, seed)
    with one_torch_thread():
        return (codes.detach() @ classifier.detach()).argmax(1).numpy()


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Classify the Gaussians at each level, and assign each identity the mean code of its masks.

    A level without identities gets zeros.
    """
    contributions, latents = inputs.contributions, inputs.latents
    views, features = labelled_views(inputs, settings.pixel_step), inputs.no_features()
    identities = mask_identities(contributions, inputs.threads)
    for level in LEVELS:
        identity = np.where(contributions.level == int(level), identities, NONE)
        has = identity != NONE
        if not has.any():
            continue
        group = identity_of_gaussians(views, contributions, identity, level, settings, seed + level.index)
        means, _ = group_means(latents[has], identity[has], int(identity.max()) + 1)
        features[:, level.index] = features_of_groups(group, means.astype(np.float32))
    return features
