"""Faster networks of lower precision: int8 on a CPU, dynamically quantised, and float16 on a card.

Stages check them on the scene's own photographs.
"""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hilsplat.base.atomic import atomic_path
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.lineage import sha256_of_json, version_of
from hilsplat.base.removal import is_unfinished
from hilsplat.models.card import CPU
from hilsplat.models.folder import ModelFolder, external_weights, input_side_px
from hilsplat.models.network import Network, or_as_exported
from hilsplat.models.onnx_graph import Graph, needed_names
from hilsplat.models.repeatable import random_pixels, require_repeatable_once

logger = logging.getLogger(__name__)

RECIPE = "dynamic, per channel, 1"
"""Version of the quantisation: change it whenever quantising the same network produces different bytes."""

WORDS = (
    *("object", "things", "stuff", "texture", "person", "face", "hand", "animal", "head", "toy", "cup"),
    *("bottle", "plate", "food", "fruit", "table", "chair", "sofa", "bed", "cushion", "blanket", "lamp"),
    *("book", "screen", "door", "window", "wall", "floor", "plant", "tree", "car", "wheel", "button"),
)
"""Texts ranked for each crop: the canonical phrases of LERF and everyday words."""

MIN_AGREEMENT = {"mask IoU": 0.98, "cosine": 0.99, "rank correlation": 0.95}
"""Minimum agreement with float32: mean IoU of masks from the same prompts, mean cosine of vectors,
and rank correlation of `WORDS` by cosine with a crop. Two crops of one object from neighbouring views agree
less."""
LARGE_BYTES = 1_000_000_000
"""Size of a network above which int8 is used only if required, because quantising takes four times as much
memory."""
CHECKED_CROPS, CHECKED_VIEWS, CHECKED_GRID = 16, 2, 5
"""Number of crops used to check a CLIP model; numbers of views and of prompts per side for a SAM model."""


def reduced_precision(precision: str, model: ModelFolder, name: str, device: str = CPU) -> str:
    """Return the precision to compare a network with in float32: "int8", "fp16", or "" for none.

    `auto` ignores large networks on a CPU, such as those of ViT-L and ViT-H. A warning is logged if int8 is
    required but cannot save time: on a card, or for a model of the synthetic world.
    """
    is_world = bool(model.config.get("world_only"))
    if precision == "int8" and (is_world or device != CPU):
        logger.warning("%s runs in float32: int8 requires a pretrained model on a CPU", model.folder)
    if is_world or precision == "fp32":
        return ""
    if device != CPU:
        return "fp16" if precision == "auto" else ""
    path = model.networks[name]
    num_bytes = sum(file.stat().st_size for file in (path, *external_weights(path)))
    return "int8" if precision == "int8" or num_bytes <= LARGE_BYTES else ""


def int8_network(
    model: ModelFolder, name: str, cache: Path, graph: Graph | None = None, exact: Sequence[str] = ()
) -> Network | None:
    """Open the int8 version of a model's network, which `hilsplat models get` or the first use computes.

    The int8 version is stored beside the model folder, in `.int8`, named by a digest of its source. If it
    cannot be computed, a warning is logged and None is returned.

    Args:
        cache: folder to use instead if the model's parent folder is read-only.
        graph: a modified network to use instead of the network's file.
        exact: outputs that stay in float32, such as sines of large arguments.
    """

    def prepare() -> Network:
        source = graph or Graph.read(model.networks[name])
        beside = model.folder.parent  # a new file in the model folder could change its digest
        while is_unfinished(beside):  # `hilsplat models get` checks a model before it installs it
            beside = beside.parent
        folder = beside if os.access(beside, os.W_OK) else cache
        path = folder / ".int8" / f"{sha256_of_json([source.digest, RECIPE, list(exact)])}.onnx"
        if not path.is_file():
            logger.info(
                "quantising %s of %s, which takes up to half a minute; the result is kept", name, model.folder
            )
            _quantise(source, path, exact)
        network = model.network(name, path)
        require_repeatable_once(model, network, "int8", random_pixels(network, input_side_px(model)))
        return network

    return or_as_exported(model.networks[name], "each image takes about twice as long", prepare)


def _quantise(source: Graph, out: Path, exact: Sequence[str]) -> None:
    from onnxruntime.quantization import QuantType, quantize_dynamic

    graph = source.complete()
    # onnxruntime logs a line for each layer that stays in float32, with functions of `logging` itself
    logging.getLogger().addFilter(_is_error)
    try:
        with atomic_path(out) as temporary:
            quantize_dynamic(
                graph,
                str(temporary),
                per_channel=True,
                weight_type=QuantType.QInt8,
                op_types_to_quantize=["MatMul", "Gemm"],
                nodes_to_exclude=_nodes_only_for(graph.graph, exact),
            )
    finally:
        logging.getLogger().removeFilter(_is_error)


def _is_error(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR


def _nodes_only_for(graph: Any, outputs: Sequence[str]) -> list[str]:
    needed = needed_names(graph, outputs)
    others = needed_names(graph, [value.name for value in graph.output if value.name not in outputs])
    return sorted(
        node.name
        for node in graph.node
        if needed.intersection(node.output) and others.isdisjoint(node.output)
    )


def use_reduced(
    reduced: str,
    precision: str,
    what: str,
    cache: Path,
    inputs: Mapping[str, object],
    measure: Callable[[], dict[str, float]],
) -> bool:
    """Return whether to use a network of lower precision, and log the measured agreement.

    Args:
        reduced: "int8" or "fp16".
        precision: setting; if it equals `reduced`, the network is used whatever is measured.
        what: name of the network in the log.
        inputs: digests of the model and of the data that `measure` reads; with its code, the cache key.
        measure: function that returns the agreement with float32, by keys of `MIN_AGREEMENT`.
    """
    form = [RECIPE] if reduced == "int8" else [reduced, version_of("torch")]
    key = [*form, inputs, code_digest(measure)]
    agreement = ViewCache(cache / "int8").get(
        sha256_of_json(key), lambda: {name: np.array([value]) for name, value in measure().items()}
    )
    minima = [(name, float(value[0]), MIN_AGREEMENT[name]) for name, value in agreement.items()]
    is_used = precision == reduced or all(value >= minimum for _, value, minimum in minima)
    measured = ", ".join(f"{name} {value:.4f} (minimum: {minimum})" for name, value, minimum in minima)
    used = reduced if is_used else "float32"
    logger.info("%s runs in %s. %s vs. float32: %s", what, used, reduced, measured)
    return is_used


def agreement_of_vectors(
    full: Float[np.ndarray, "B C"], quantised: Float[np.ndarray, "B C"], texts: Float[np.ndarray, "T C"]
) -> dict[str, float]:
    """Compare the crops' unit vectors in both precisions, directly and by their rankings of texts."""
    ranks = [np.argsort(np.argsort(vectors @ texts.T, axis=1), axis=1) for vectors in (full, quantised)]
    centred = [rank - rank.mean(axis=1, keepdims=True) for rank in ranks]
    order = (centred[0] * centred[1]).sum() / max(float(np.square(centred[0]).sum()), 1e-12)
    return {"cosine": float((full * quantised).sum(axis=1).mean()), "rank correlation": float(order)}


def agreement_of_masks(
    full: Bool[np.ndarray, "K h w"], quantised: Bool[np.ndarray, "K h w"]
) -> dict[str, float]:
    """Compare the masks in both precisions for the same prompts; pairs of empty masks are ignored."""
    union, shared = (full | quantised).sum(axis=(1, 2)), (full & quantised).sum(axis=(1, 2))
    return {"mask IoU": float((shared[union > 0] / union[union > 0]).mean()) if union.any() else 0.0}
