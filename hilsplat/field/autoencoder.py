"""Stage `autoencoder`: fit the scene's code, a network or PCA, and encode the masks with it.

The network is trained with closed-form gradients and BLAS: its matrices are so small (64 x 128) that torch's
overhead would take most of a step.
"""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from hilsplat.base.artifacts import read_index, write_index, write_npz
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.errors import ArtifactError
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.progress import stage_log
from hilsplat.embed.vectors import mask_embeddings, require_every_vector
from hilsplat.field import code
from hilsplat.field.adam import Adam
from hilsplat.field.kernels import swap
from hilsplat.segment.digests import MASKS_SHA256, digests_in, require_same_masks
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import AutoencoderSettings

Arrays = dict[str, np.ndarray]

# Values for the backward pass through a layer: inputs (B, I) of the linear layer, after BatchNorm and ReLU;
# normalised inputs (B, I) of the BatchNorm and reciprocal standard deviations (I), empty without BatchNorm.
Passed = tuple[np.ndarray, np.ndarray, np.ndarray]


def run_autoencoder(
    clip_folder: Path,
    semantic_tree_folder: Path,
    contributions_folder: Path,
    out: Path,
    settings: AutoencoderSettings,
    seed: int,
    code_folder: Path | None = None,
) -> None:
    """Fit the scene's code, or read that of `code_folder`, and encode the target vector of every mask.

    The target is the vector of the node that the mask fits best, or the mean over all nodes for a mask that
    shares no Gaussian with any node. With `targets: mask`, as in the paper, or without nodes, it is the
    mask's own vector. Writes `autoencoder.safetensors`, `latents.npz` (rows as in the contributions) and
    `index.json`.

    Raises:
        MisalignedArtifactError: the semantic tree or the CLIP vectors belong to different masks.
        ArtifactError: a mask needs its own vector and has none, or the code is for other vectors or sizes.
    """
    require_same_masks(semantic_tree_folder, contributions_folder)
    tree = SemanticTree.load(semantic_tree_folder, clip_folder)
    clip = mask_embeddings(clip_folder, contributions_folder)
    if settings.targets == "node" and len(tree):
        or_mean = np.append(tree.clip, tree.clip.mean(axis=0, keepdims=True), axis=0)
        target, train = or_mean[tree.node_of_mask], tree.clip
    else:
        require_every_vector(clip, clip_folder, "autoencoder.targets: mask")
        target = train = clip
    with stage_log("autoencoder", read_index(contributions_folder)["scene"]) as counts:
        model: code.Code
        if code_folder is not None:
            model = code.load_code(code_folder)
            expected, found = (train.shape[1], settings.latent), (model.channels, model.latent)
            if found != expected:
                raise ArtifactError(
                    f"the code in {code_folder} does not fit the vectors in {clip_folder}",
                    expected="vectors of {} numbers and codes of {}".format(*expected),
                    found="{} and {}".format(*found),
                    fix="pass the folder of a code for this scene with the same settings",
                )
        elif settings.code == "pca":
            model = code.LinearCode.fit(train, settings.latent)
        else:
            model = train_autoencoder(train, settings, seed)
        latents = model.encode_array(target)
        decoded = model.decode_array(model.encode_array(train))
        cosine = float((decoded * train).sum(axis=1).mean())
        embedded = np.flatnonzero(clip.any(axis=1))
        own_cosine = float((model.decode_array(latents[embedded]) * clip[embedded]).sum(axis=1).mean())
        counts |= {"vectors": len(train), "mean decoder cosine": round(cosine, 4)}
        with atomic_folder(out) as folder:
            model.save(code.autoencoder_file(folder))
            write_npz(folder / "latents.npz", latents=latents)
            write_index(
                folder,
                {view: {MASKS_SHA256: digest} for view, digest in digests_in(contributions_folder).items()},
                code=settings.code,
                channels=model.channels,
                latent=model.latent,
                vectors=len(train),
                masks=len(clip),
                decoder_cosine=round(cosine, 6),
                decoder_cosine_own=round(own_cosine, 6),
                autoencoder_sha256=sha256_of_file(code.autoencoder_file(folder)),
            )


def train_autoencoder(
    vectors: Float32[np.ndarray, "B C"], settings: AutoencoderSettings, seed: int
) -> code.Autoencoder:
    """Train on one scene's unit vectors, using Adam with cosine decay and full batches without replacement.

    Identical inputs and seeds produce identical bytes for any number of stage threads (the command line
    limits BLAS to one thread). The seed determines the initial weights and the order of vectors.
    """
    twister = np.random.RandomState(seed % 2**32)  # initialised like torch's by `torch.manual_seed(seed)`
    channels, latent = vectors.shape[1], settings.latent
    data = np.ascontiguousarray(vectors)
    if len(data) == 1:
        data = np.repeat(data, 2, axis=0)  # BatchNorm needs two rows
    batch = min(settings.batch, len(data))
    per_epoch = len(data) // batch
    steps = max(settings.epochs * per_epoch, settings.min_steps)
    arrays = code.Autoencoder.initial(channels, latent, twister).arrays
    drawn = {name: values for name, values in arrays.items() if "running" not in name}
    flat = np.concatenate([values.reshape(-1) for values in drawn.values()])
    slope = np.empty_like(flat)
    parameters, gradients = _as_arrays(flat, drawn), _as_arrays(slope, drawn)
    adam = Adam(flat, settings.learning_rate, eps=1e-8)
    for step in range(steps):
        number = step % per_epoch
        if number == 0:
            order = torch_order(len(data), twister)
        chosen = data[order[number * batch : (number + 1) * batch]]
        loss_gradients(parameters, chosen, latent, settings.cosine_weight, gradients)
        adam.rate = settings.learning_rate * (1 + math.cos(math.pi * step / steps)) / 2
        adam.step(slope)
    return code.Autoencoder(channels, latent, parameters | statistics(parameters, data, latent))


def torch_order(count: int, twister: np.random.RandomState) -> Int64[np.ndarray, " n"]:
    """Return the order that `torch.randperm(count)` returns for this generator state."""
    order = np.arange(count)
    swap(order, twister.randint(0, 2**32, max(count - 1, 0), np.uint32))
    return order


def _as_arrays(flat: Float32[np.ndarray, " P"], like: Arrays) -> Arrays:
    """Return consecutive views of `flat` with the names and shapes of `like`."""
    parts = np.split(flat, np.cumsum([values.size for values in like.values()])[:-1])
    return {name: part.reshape(like[name].shape) for name, part in zip(like, parts, strict=True)}


def loss_gradients(
    parameters: Arrays,
    vectors: Float32[np.ndarray, "B C"],
    latent: int,
    cosine_weight: float,
    gradients: Arrays,
) -> None:
    """Write the gradients of the mean squared error plus `cosine_weight` times the mean of 1 - cosine.

    Inputs and outputs have unit length, so a vector's squared error, summed over C, is 2 (1 - cosine).

    Departs: LangSplat computes the cosine along the batch axis, which compares channels, not vectors.
    """
    channels = vectors.shape[1]
    encoder, decoder = code.layers_of(channels, latent)
    codes, to_codes = _forward(parameters, encoder, vectors)
    latents = code.unit_rows(codes)
    outputs, to_outputs = _forward(parameters, decoder, latents)
    slope = -vectors * np.float32((2 / channels + cosine_weight) / len(vectors))
    slope = _backward(parameters, decoder, to_outputs, _slope_before_unit(outputs, slope), gradients)
    _backward(parameters, encoder, to_codes, _slope_before_unit(codes, slope), gradients)


def statistics(parameters: Arrays, data: Float32[np.ndarray, "B C"], latent: int) -> Arrays:
    """Compute the mean and unbiased variance of all vectors at each BatchNorm, for use after training."""
    running: Arrays = {}
    encoder, _ = code.layers_of(data.shape[1], latent)
    values = data
    for layer, after in pairwise(encoder):
        values = _forward(parameters, [layer], values)[0]
        running[f"{after.norm}.running_mean"] = values.mean(axis=0)
        running[f"{after.norm}.running_var"] = values.var(axis=0, ddof=1)
    return running


def _forward(
    parameters: Arrays, layers: list[code.Layer], values: np.ndarray
) -> tuple[np.ndarray, list[Passed]]:
    """Return the layers' outputs, normalised with batch statistics, and the values for the backward pass."""
    passed = []
    for layer in layers:
        scaled, spread = values[:0], values[:0, 0]
        if layer.norm:
            norm = parameters[f"{layer.norm}.weight"], parameters[f"{layer.norm}.bias"]
            scaled, spread, values = _normalised(values, *norm)
        elif layer.relu:
            values = np.maximum(values, 0)
        passed.append((values, scaled, spread))
        values = values @ parameters[f"{layer.name}.weight"].T
        values += parameters[f"{layer.name}.bias"]
    return values, passed


def _backward(
    parameters: Arrays, layers: list[code.Layer], passed: list[Passed], slope: np.ndarray, gradients: Arrays
) -> np.ndarray:
    """Compute the gradients of the layers' parameters, and return the gradient of their inputs."""
    for layer, (values, scaled, spread) in zip(layers[::-1], passed[::-1], strict=True):
        np.matmul(slope.T, values, out=gradients[f"{layer.name}.weight"])
        np.sum(slope, axis=0, out=gradients[f"{layer.name}.bias"])
        slope = slope @ parameters[f"{layer.name}.weight"]
        if layer.relu:
            slope *= values > 0
        if layer.norm:
            of_weight, of_bias = (gradients[f"{layer.norm}.{name}"] for name in ("weight", "bias"))
            np.sum(slope * scaled, axis=0, out=of_weight)
            np.sum(slope, axis=0, out=of_bias)
            common = np.float32(1 / len(slope)) * (of_bias + scaled * of_weight)
            slope = parameters[f"{layer.norm}.weight"] * spread * (slope - common)
    return slope


def _slope_before_unit(values: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Convert the gradient with respect to the output of `unit_rows` to that with respect to its input."""
    length = np.sqrt(np.square(values).sum(axis=1, keepdims=True))
    units = values / length
    return (slope - units * (units * slope).sum(axis=1, keepdims=True)) / length


def _normalised(values: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> Passed:
    """Apply BatchNorm (batch statistics) and ReLU; return normalised inputs, 1 / deviation and outputs."""
    share = np.float32(1 / len(values))
    centred = values - (share * values).sum(axis=0)
    spread = 1 / np.sqrt((share * np.square(centred)).sum(axis=0) + np.float32(code.NORM_EPS))
    scaled = centred * spread
    return scaled, spread, np.maximum(scaled * weight + bias, 0)
