"""Hand-made networks, masks and scenes, small enough to compute their results by hand."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from hilsplat.base.images import write_png
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings

FRAME, LOW = 32, 16
RADII = (3.0, 6.0, 10.0)
"""Radii of the disc decoder's masks (subpart, part, whole), px of the 32 px input."""
SCORES = (0.9, 0.8, 0.7)


def pack(
    dense: np.ndarray, level: Sequence[int] | None = None, predicted_iou: Sequence[float] | None = None
) -> HierarchicalMasks:
    """Masks of level 1 and predicted IoU 1 unless given, and stability 1."""
    ones = np.ones(len(dense), np.float32)
    return HierarchicalMasks.from_dense(
        np.asarray(dense, bool),
        ones.astype(np.uint8) if level is None else np.array(level, np.uint8),
        ones if predicted_iou is None else np.array(predicted_iou, np.float32),
        ones,
    )


def assert_equal_masks(found: HierarchicalMasks, expected: HierarchicalMasks) -> None:
    for name, array in expected.arrays().items():
        np.testing.assert_array_equal(found.arrays()[name], array, err_msg=name)


def generate(model: SamModel, settings: MasksSettings, image: np.ndarray) -> HierarchicalMasks:
    candidates = decode_candidates(image, model, settings)
    return masks_from_candidates(candidates, image.shape[:2], model, settings)


def save_scene(
    folder: Path, images: Mapping[str, np.ndarray], test: Sequence[str] = (), K: np.ndarray | None = None
) -> Path:
    """A posed scene `set/scene` without points; views are training views unless named in `test`."""
    for name, image in images.items():
        write_png(folder / "images" / name, image)
    sizes = np.array([image.shape[:2] for image in images.values()], np.int32)
    eyes = np.tile(np.eye(4), (len(images), 1, 1))
    intrinsics = eyes[:, :3, :3] if K is None else np.tile(K, (len(images), 1, 1))
    cameras = Cameras(tuple(images), eyes, intrinsics, sizes)
    split = {name: "test" if name in test else "train" for name in images}
    none = np.zeros((0, 3), np.float32)
    Scene(folder, "set/scene", "metre", cameras, split, none, none.astype(np.uint8), np.eye(4)).save()
    return folder


def save_network(
    path: Path, nodes: list, inputs: list, outputs: list, constants: dict[str, np.ndarray]
) -> None:
    initialisers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "hand-made", inputs, outputs, initialisers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())


def move_weights(path: Path, location: str) -> None:
    """Move a network's weights and constants to a separate file."""
    model = onnx.load(path)
    path.unlink()
    options = {"size_threshold": 64, "convert_attribute": True}
    onnx.save(model, path, save_as_external_data=True, location=location, **options)


def tensor(name: str, shape: list, kind: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def _write_disc_decoder(path: Path, every: slice, points_name: str, heads: int, cell_px: float) -> None:
    """Write the decoder of `write_disc_sam`; masks contain only the rows and columns in `every`."""
    centres = ((np.arange(LOW, dtype=np.float32) + 0.5) * FRAME / LOW)[every]
    low = len(centres)
    x, y = np.meshgrid(centres, centres)
    to_middle_of_cell = [
        helper.make_node("Div", [points_name, "cell"], ["in_cells"]),
        helper.make_node("Floor", ["in_cells"], ["corner"]),
        helper.make_node("Add", ["corner", "half"], ["middle"]),
        helper.make_node("Mul", ["middle", "cell"], ["centre"]),
    ]
    save_network(
        path,
        [
            *(to_middle_of_cell if cell_px else [helper.make_node("Identity", [points_name], ["centre"])]),
            helper.make_node("Sub", ["centre", "grid"], ["offset"]),  # (1, P, 256, 2)
            helper.make_node("Mul", ["offset", "offset"], ["squared"]),
            helper.make_node("ReduceSum", ["squared", "last"], ["sum"], keepdims=0),
            helper.make_node("Sqrt", ["sum"], ["distance"]),
            helper.make_node("Unsqueeze", ["distance", "two"], ["apart"]),  # (1, P, 1, 256)
            helper.make_node("Sub", ["radii", "apart"], ["logits"]),  # (1, P, 3, 256)
            helper.make_node("Reshape", ["logits", "shape"], ["pred_masks"]),
            helper.make_node("ReduceMax", ["logits"], ["peak"], axes=[3], keepdims=0),
            helper.make_node("Mul", ["peak", "zero"], ["nothing"]),
            helper.make_node("Add", ["nothing", "scores"], ["iou_scores"]),
        ],
        [
            tensor(points_name, [1, "P", 1, 2]),
            tensor("input_labels", [1, "P", 1], TensorProto.INT64),
            tensor("image_embeddings", [1, 3, LOW, LOW]),
            tensor("image_positional_embeddings", [1, 3, LOW, LOW]),
        ],
        [tensor("iou_scores", [1, "P", heads]), tensor("pred_masks", [1, "P", heads, low, low])],
        {
            "cell": np.array([cell_px], np.float32),
            "half": np.array([0.5], np.float32),
            "grid": np.stack([x.reshape(-1), y.reshape(-1)], axis=1)[None, None],
            "last": np.array([3]),
            "two": np.array([2]),
            "radii": np.array((RADII + RADII)[:heads], np.float32)[None, None, :, None],
            "shape": np.array([1, -1, heads, low, low]),
            "zero": np.zeros(1, np.float32),
            "scores": np.array((SCORES + SCORES)[:heads], np.float32),
        },
    )


def write_disc_sam(
    folder: Path, points_name: str = "input_points", heads: int = 3, cell_px: float = 0
) -> Path:
    """Write a SAM that returns three discs around each point: logit = radius - distance, px of the input.

    With `cell_px`, discs are centred in the point's grid cell, and the model has a preview.
    """
    save_network(
        folder / "onnx" / "vision_encoder.onnx",
        [
            helper.make_node(
                "AveragePool", ["pixel_values"], ["image_embeddings"], kernel_shape=[2, 2], strides=[2, 2]
            ),
            helper.make_node("Identity", ["image_embeddings"], ["image_positional_embeddings"]),
        ],
        [tensor("pixel_values", ["batch", 3, FRAME, FRAME])],
        [
            tensor("image_embeddings", ["batch", 3, LOW, LOW]),
            tensor("image_positional_embeddings", ["batch", 3, LOW, LOW]),
        ],
        {},
    )
    networks = {DECODER: slice(None), PREVIEW: slice(None, None, 2)} if cell_px else {DECODER: slice(None)}
    for name, every in networks.items():
        _write_disc_decoder(folder / "onnx" / f"{name}.onnx", every, points_name, heads, cell_px)
    own = {"predicted_iou_min": 0.35, "stability_min": 0.5, "nms_score": 0.0, "points_per_batch": 64}
    (folder / "config.json").write_text(json.dumps({"model_type": "sam", "mask_generation": own}))
    sizes = {"size": {"longest_edge": FRAME}, "pad_size": {"height": FRAME, "width": FRAME}}
    statistics = {"image_mean": [0.5] * 3, "image_std": [0.25] * 3, "rescale_factor": 1 / 255, "resample": 2}
    (folder / "preprocessor_config.json").write_text(json.dumps(sizes | statistics))
    return folder
