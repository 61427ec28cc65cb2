"""Dynamically quantised int8 networks. Stages check them on the scene's own photographs."""

import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from hilsplat.base.artifacts import ViewCache, atomic_path, sha256_of_bytes, sha256_of_file, sha256_of_json
from hilsplat.models.folder import ModelFolder
from hilsplat.models.network import Network, execution_providers
from hilsplat.models.onnx_graph import needed_names

logger = logging.getLogger(__name__)

RECIPE = "dynamic, per channel, 1"
"""Version of the quantisation: it changes whenever the same network would give other bytes."""

WORDS = (
    *("object", "things", "stuff", "texture", "person", "face", "hand", "animal", "head", "toy", "cup"),
    *("bottle", "plate", "food", "fruit", "table", "chair", "sofa", "bed", "cushion", "blanket", "lamp"),
    *("book", "screen", "door", "window", "wall", "floor", "plant", "tree", "car", "wheel", "button"),
)
"""Texts that each crop ranks: the canonical phrases of LERF and everyday words."""

LEAST_COSINE, LEAST_RANK_CORRELATION = 0.99, 0.95
"""Minimum mean cosine between the vectors of both precisions, and minimum rank correlation of `WORDS` by
cosine with a crop. Two crops of one object from neighbouring views differ by more."""

LEAST_IOU = 0.98
"""Minimum mean IoU between the masks of both precisions for the same prompts."""

CHECKED_CROPS, CHECKED_VIEWS, CHECKED_GRID = 16, 2, 5
"""Number of crops for checking a CLIP; number of views, and of prompts per side, for checking a SAM."""


def may_be_int8(model: ModelFolder) -> bool:
    """Return whether int8 can save time: on a CPU, for models other than those of the synthetic world."""
    return execution_providers()[0] == "CPUExecutionProvider" and not model.config.get("world_only")


def int8_network(
    model: ModelFolder, name: str, cache: Path, graph: bytes | None = None, exact: Sequence[str] = ()
) -> Network:
    """Open the int8 version of a model's network, which `hilsplat models get` or the first use computes.

    It is stored beside the model folder, in `.int8`, under a digest of its source.

    Args:
        cache: folder to use instead if the model's parent folder is read-only.
        graph: a modified graph to use instead of the network's file.
        exact: outputs that stay in float32, such as sines of large arguments.

    Raises:
        ModelError: the network cannot be opened.
    """
    source = sha256_of_file(model.networks[name]) if graph is None else sha256_of_bytes(graph)
    beside = model.folder.parent  # a new file in the model folder could change its digest
    folder = beside if os.access(beside, os.W_OK) else Path(cache)
    path = folder / ".int8" / f"{sha256_of_json([source, RECIPE, list(exact)])}.onnx"
    if not path.is_file():
        logger.info("quantising %s of %s, once: seconds; later runs read it", name, model.folder)
        _quantise(model.networks[name] if graph is None else graph, path, exact)
    return model.network(name, graph=path.read_bytes())


def _quantise(network: Path | bytes, out: Path, exact: Sequence[str]) -> None:
    import onnx
    from onnxruntime.quantization import QuantType, quantize_dynamic

    graph = onnx.load_from_string(network) if isinstance(network, bytes) else onnx.load(str(network))
    logging.disable(logging.WARNING)  # onnxruntime logs a line for each layer that stays in float32
    try:
        with atomic_path(out) as temporary:
            quantize_dynamic(
                graph,
                str(temporary),
                per_channel=True,
                weight_type=QuantType.QInt8,
                op_types_to_quantize=["MatMul", "Gemm"],
                nodes_to_exclude=_leading_only_to(graph.graph, exact),
            )
    finally:
        logging.disable(logging.NOTSET)


def _leading_only_to(graph: Any, outputs: Sequence[str]) -> list[str]:
    """Return the names of nodes that are needed for the given outputs only."""
    needed = needed_names(graph, outputs)
    others = needed_names(graph, [each.name for each in graph.output if each.name not in outputs])
    return sorted(
        node.name
        for node in graph.node
        if needed.intersection(node.output) and others.isdisjoint(node.output)
    )


@dataclass(frozen=True)
class Agreement:
    """Agreement of an int8 network with its float32 original: measured values, and the least accepted."""

    values: dict[str, float]
    least: dict[str, float]

    def decide(self, precision: str, what: str) -> bool:
        """Return whether to use int8 (`precision` is "auto" or "int8"), and log the decision."""
        agrees = all(self.values[name] >= least for name, least in self.least.items())
        use = agrees or precision == "int8"
        said = ", ".join(f"{name} {self.values[name]:.4f} (least: {at})" for name, at in self.least.items())
        logger.info("%s runs in %s. int8 and float32: %s", what, "int8" if use else "float32", said)
        return use

    @staticmethod
    def remembered(cache: Path, inputs: object, measure: Callable[[], "Agreement"]) -> "Agreement":
        """Return the cached agreement for the same inputs (digests of model and data), or measure it."""

        def arrays() -> dict[str, np.ndarray]:
            found = measure()
            return {name: np.array([value, found.least[name]]) for name, value in found.values.items()}

        kept = ViewCache(Path(cache) / "int8").get(sha256_of_json([RECIPE, inputs]), arrays)
        return Agreement(*({name: float(pair[k]) for name, pair in kept.items()} for k in (0, 1)))


def agreement_of_vectors(
    full: Float[np.ndarray, "B C"], quantised: Float[np.ndarray, "B C"], texts: Float[np.ndarray, "T C"]
) -> Agreement:
    """Compare the crops' unit vectors of both precisions, directly and by how they rank texts."""
    ranks = [np.argsort(np.argsort(vectors @ texts.T, axis=1), axis=1) for vectors in (full, quantised)]
    centred = [rank - rank.mean(axis=1, keepdims=True) for rank in ranks]
    order = (centred[0] * centred[1]).sum() / max(float(np.square(centred[0]).sum()), 1e-12)
    values = {"cosine": float((full * quantised).sum(axis=1).mean()), "rank correlation": float(order)}
    return Agreement(values, {"cosine": LEAST_COSINE, "rank correlation": LEAST_RANK_CORRELATION})


def agreement_of_masks(full: Bool[np.ndarray, "K h w"], quantised: Bool[np.ndarray, "K h w"]) -> Agreement:
    """Compare the masks of both precisions for the same prompts; pairs of empty masks are ignored."""
    union, shared = (full | quantised).sum(axis=(1, 2)), (full & quantised).sum(axis=(1, 2))
    iou = float((shared[union > 0] / union[union > 0]).mean()) if union.any() else 0.0
    return Agreement({"mask IoU": iou}, {"mask IoU": LEAST_IOU})
