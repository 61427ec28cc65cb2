"""LEGaussians: a small code and an uncertainty per Gaussian, decoded to a codebook entry.

1. The CLIP vectors of the masks are quantised to 128 entries, so every pixel has an index.
2. Every Gaussian learns 8 numbers and an uncertainty; a small network predicts the entry of each rendered
   pixel (cross-entropy, weighted by 1 - uncertainty, plus -log(1 - uncertainty)).
3. Another network predicts the 8 numbers from the position; the numbers are pulled towards the prediction,
   more strongly if they are uncertain.

Source: Shi et al., Language Embedded 3D Gaussians, CVPR 2024; buaavrcg/LEGaussians `train.py`,
`scene/index_decoder.py`, `arguments/__init__.py`. The constants below are the authors' unless stated
otherwise; they use `steps` 30,000, and `rate` 0.001 for codes and networks.

Departs:
    - mask CLIP vectors are indexed with a k-means codebook per level; the authors quantise a pyramid of
      CLIP crops with DINO features, which masks do not have, and train the codebook with balanced loads;
    - geometry is frozen instead of trained together with the codes;
    - fewer steps, on 1024 pixels of a view; almost identical initial codes; networks learn at a fifth of the
      rate; no weight decay (the authors use 1e-5);
    - 1000 Gaussians are smoothed at every step with 10 % of the weight, instead of all Gaussians at every
      tenth step; positions are scaled to a standard deviation of 1;
    - each Gaussian gets the entry with the largest logit, which is then rendered; the authors decode rendered
      codes at each pixel to the most probable entry or a softmax mixture.
"""

import itertools

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from hilsplat.base.levels import LEVELS
from hilsplat.baselines import TrainedSettings
from hilsplat.methods.common import training
from hilsplat.methods.common.groups import kmeans, standardised
from hilsplat.methods.method import LabelledView, MethodInputs, labelled_views

ENTRIES = 128
CHANNELS = 8
DECODER_WIDTHS = (128, 256)
POSITION_WIDTHS = (128,) * 4
FIRST_UNCERTAINTY = 0.01
UNCERTAINTY_RATE = 0.05  # Adam's rate for uncertainties, independent of the codes' rate
NETWORK_RATE = 0.2  # factor of the codes' rate for the networks; the authors use 1
MIN_SMOOTHING = 0.1  # smoothing weight of a fully certain Gaussian; fully uncertain ones have weight 1
SMOOTHING = 0.1
SAMPLES = 1000
PIXELS = 1024


def network(sizes: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inward, outward in itertools.pairwise(sizes):
        layers += [nn.Linear(inward, outward), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def index_loss(
    logits: Float[Tensor, "p E"], index: Int64[Tensor, " p"], uncertainty: Float[Tensor, " p"]
) -> Float[Tensor, ""]:
    """Return the mean cross-entropy, weighted by 1 - u, plus the penalty -log(1 - u) of uncertainty u."""
    certain = 1 - uncertainty
    return (cross_entropy(logits, index, reduction="none") * certain).mean() - certain.log().mean()


def smoothing_loss(
    codes: Float[Tensor, "s 8"], predicted: Float[Tensor, "s 8"], uncertainty: Float[Tensor, " s"]
) -> Float[Tensor, ""]:
    """Return squared distances that pull predictions to codes, and uncertain codes to predictions."""
    weight = MIN_SMOOTHING + (1 - MIN_SMOOTHING) * uncertainty.detach()
    follow = (predicted - codes.detach()).square().mean(1).mean()
    return follow + ((predicted.detach() - codes).square().mean(1) * weight).mean()


def fit(inputs: MethodInputs, settings: TrainedSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Quantise the codes, train, and look up the entries; Gaussians in no mask of a level get zeros."""
    contributions, latents = inputs.contributions, inputs.latents
    codebooks, entry = [], np.zeros(len(latents), np.int64)
    for level in LEVELS:
        rows = contributions.rows_of(level)
        codebook, entry[rows] = kmeans(latents[rows], ENTRIES, seed + level.index)
        codebooks.append(codebook)
    views, num, levels = labelled_views(inputs, settings.pixel_step), contributions.num_gaussians, len(LEVELS)
    codes = training.initial_features(num, levels * CHANNELS, seed)
    doubt = torch.full((num, levels), float(np.log(FIRST_UNCERTAINTY / (1 - FIRST_UNCERTAINTY))))
    doubt.requires_grad_()
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(seed)
        decoders = [network((CHANNELS, *DECODER_WIDTHS, ENTRIES)) for _ in LEVELS]
        position = network((3, *POSITION_WIDTHS, levels * CHANNELS))
    places = torch.from_numpy(standardised(contributions.means()))

    def loss(view: LabelledView, random: np.random.Generator, _: float) -> Tensor:
        weights, gaussians = training.nonempty_columns(view.weights)
        rendered = training.product(weights, codes[gaussians]).reshape(-1, levels, CHANNELS)
        uncertainty = training.product(weights, doubt[gaussians].sigmoid())
        chosen = torch.from_numpy(random.integers(num, size=min(SAMPLES, num)))
        total = SMOOTHING * smoothing_loss(
            codes[chosen].reshape(-1, CHANNELS),
            position(places[chosen]).reshape(-1, CHANNELS),
            doubt[chosen].sigmoid().reshape(-1),
        )
        for level in LEVELS:
            inside = view.at(level)
            if len(inside):
                target = torch.from_numpy(entry[view.rows[view.labels[inside, level.index]]])
                logits = decoders[level.index](training.unit(rendered[inside, level.index]))
                total = total + index_loss(logits, target, uncertainty[inside, level.index])
        return total

    networks = [weight for part in (*decoders, position) for weight in part.parameters()]
    groups = [
        {"params": [codes]},
        {"params": networks, "lr": NETWORK_RATE * settings.rate},
        {"params": [doubt], "lr": UNCERTAINTY_RATE},
    ]
    training.train(views, groups, loss, settings, seed, PIXELS)
    with training.one_torch_thread(), torch.no_grad():
        unit_codes = training.unit(codes.reshape(num, levels, CHANNELS))
        features = [book[decoders[k](unit_codes[:, k]).argmax(1).numpy()] for k, book in enumerate(codebooks)]
    return np.where(inputs.seen()[..., None], np.stack(features, axis=1), np.float32(0))
