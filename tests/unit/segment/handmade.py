"""Hand-made networks, masks and scenes, small enough to compute their results by hand."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnx import helper, numpy_helper

from hilsplat.base.images import write_png
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import LOGIT_STEP, SamModel
from hilsplat.settings import MasksSettings

FRAME, LOW = 32, 16
RADII = (3.0, 6.0, 10.0)  # radii of the disc decoder's masks (subpart, part, whole), px of the 32 px input
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


def quantise(logits: np.ndarray) -> np.ndarray:
    """Round logits to steps, clipped to +-127."""
    return np.clip(np.rint(logits / LOGIT_STEP), -127, 127).astype(np.int8)


def smooth_logits(count: int, side: int, seed: int) -> np.ndarray:
    """Random hills and valleys, float32 (count, side, side)."""
    noise = np.random.default_rng(seed).normal(size=(count, side, side)).astype(np.float32)
    return np.stack([36 * cv2.GaussianBlur(one, (0, 0), 3) for one in noise])


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


def save_network(path: Path, text: str, **constants: np.ndarray) -> None:
    """Write a network given in ONNX's text format, with the values of its constants."""
    graph = onnx.parser.parse_graph(text)
    graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())


def move_weights(path: Path, location: str) -> None:
    """Move a network's weights and constants to a separate file."""
    model = onnx.load(path)
    path.unlink()
    options = {"size_threshold": 128, "convert_attribute": True}
    onnx.save(model, path, save_as_external_data=True, location=location, **options)


def write_disc_sam(folder: Path, cell_px: float = 0) -> Path:
    """Write a SAM that returns three discs around each point: logit = radius - distance, px of the input.

    With `cell_px`, discs are centred in the point's grid cell, and the model has a preview.
    """
    features = f"float[batch,3,{LOW},{LOW}]"
    save_network(
        folder / "onnx" / "vision_encoder.onnx",
        f"""encoder (float[batch,3,{FRAME},{FRAME}] pixel_values)
        => ({features} image_embeddings, {features} image_positional_embeddings) {{
            image_embeddings = AveragePool <kernel_shape = [2, 2], strides = [2, 2]> (pixel_values)
            image_positional_embeddings = Identity (image_embeddings)
        }}""",
    )
    to_middle_of_cell = """
        in_cells = Div (input_points, cell)
        corner = Floor (in_cells)
        middle = Add (corner, half)
        centre = Mul (middle, cell)
    """
    networks = {DECODER: slice(None), PREVIEW: slice(None, None, 2)} if cell_px else {DECODER: slice(None)}
    for name, every in networks.items():  # rows and columns of the masks
        centres = ((np.arange(LOW, dtype=np.float32) + 0.5) * FRAME / LOW)[every]
        low = len(centres)
        x, y = np.meshgrid(centres, centres)
        save_network(
            folder / "onnx" / f"{name}.onnx",
            f"""discs (
                float[1,P,1,2] input_points, int64[1,P,1] input_labels,
                {features} image_embeddings, {features} image_positional_embeddings
            ) => (float[1,P,3] iou_scores, float[1,P,3,{low},{low}] pred_masks) {{
                {to_middle_of_cell if cell_px else "centre = Identity (input_points)"}
                offset = Sub (centre, grid)
                distance = ReduceL2 <axes = [3]> (offset)
                apart = Transpose <perm = [0, 1, 3, 2]> (distance)
                logits = Sub (radii, apart)
                pred_masks = Reshape (logits, shape)
                peak = ReduceMax <axes = [3], keepdims = 0> (logits)
                nothing = Mul (peak, zero)
                iou_scores = Add (nothing, scores)
            }}""",
            cell=np.array([cell_px], np.float32),
            half=np.array([0.5], np.float32),
            grid=np.stack([x.reshape(-1), y.reshape(-1)], axis=1)[None, None],
            radii=np.array(RADII, np.float32)[None, None, :, None],
            shape=np.array([1, -1, 3, low, low]),
            zero=np.zeros(1, np.float32),
            scores=np.array(SCORES, np.float32),
        )
    own = {"predicted_iou_min": 0.35, "stability_min": 0.5, "nms_score": 0.0, "points_per_batch": 64}
    (folder / "config.json").write_text(json.dumps({"model_type": "sam", "mask_generation": own}))
    sizes = {"size": {"longest_edge": FRAME}, "pad_size": {"height": FRAME, "width": FRAME}}
    statistics = {"image_mean": [0.5] * 3, "image_std": [0.25] * 3, "rescale_factor": 1 / 255, "resample": 2}
    (folder / "preprocessor_config.json").write_text(json.dumps(sizes | statistics))
    return folder
