"""Write the small models in the layout of the Hugging Face ONNX exports of SAM and CLIP."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from hilsplat.base.artifacts import write_json
from hilsplat.base.atomic import atomic_path
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.segment.thresholds import OWN, Thresholds
from models.training import sam
from models.training.clip import CROP_PX, DIMENSIONS, Clip

MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
OPSET = 18
# Thresholds tuned for the small segmenter (docs/experiments.md) and stored in its `config.json`.
OWN_THRESHOLDS = Thresholds(predicted_iou_min=0.35, stability_min=0.5, nms_score=0.0, points_per_batch=16)
HALF_FROM = 64  # initialisers with at least this many values are stored as float16

# parts of `preprocessor_config.json` that both models share
RGB = {"do_convert_rgb": True, "do_resize": True}
SCALING = {
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": list(MEAN),
    "image_std": list(STD),
}


class _VisionEncoder(nn.Module):
    """The encoder, with the inputs of the decoder that all prompts share.

    Its outputs are the map that is sampled at the prompts, and the pixel features. They have the names of the
    encoder's outputs in SAM's layout.
    """

    positional: Tensor

    def __init__(self, encoder: sam.SamEncoder) -> None:
        super().__init__()
        self.encoder = encoder
        whole = torch.tensor([[0.0, 0.0, 1.0]])
        self.register_buffer("positional", sam.positional_embeddings(whole, sam.FRAME_PX // sam.STRIDE))

    def forward(self, pixel_values: Tensor) -> tuple[Tensor, Tensor]:
        embeddings = self.encoder(pixel_values)
        positional = self.positional.expand(pixel_values.shape[0], -1, -1, -1)
        return torch.cat([embeddings, positional], dim=1), sam.shared_features(embeddings, positional)


class _MaskDecoder(nn.Module):
    """The decoder for the outputs of `_VisionEncoder`, or its preview."""

    def __init__(self, decoder: sam.SamDecoder, preview: bool) -> None:
        super().__init__()
        self.decoder = decoder
        self.preview = preview

    def forward(self, points: Tensor, labels: Tensor, place: Tensor, shared: Tensor) -> tuple[Tensor, Tensor]:
        decode = self.decoder.preview if self.preview else self.decoder.masks
        return decode(points, labels, place, shared)


def store_as_half(model: onnx.ModelProto) -> onnx.ModelProto:
    """Store large float32 initialisers as float16, each followed by a Cast to keep float32 arithmetic."""
    graph = model.graph
    casts = []
    for initializer in list(graph.initializer):
        values = numpy_helper.to_array(initializer)
        if values.dtype != np.float32 or values.size < HALF_FROM:
            continue
        name = initializer.name
        half = numpy_helper.from_array(values.astype(np.float16), f"{name}_half")
        graph.initializer.remove(initializer)
        graph.initializer.append(half)
        casts.append(onnx.helper.make_node("Cast", [half.name], [name], to=onnx.TensorProto.FLOAT))
    for cast in reversed(casts):
        graph.node.insert(0, cast)
    onnx.checker.check_model(model)
    return model


def export_onnx(
    module: nn.Module,
    inputs: dict[str, Tensor],
    outputs: dict[str, dict[int, str]],
    dynamic: dict[str, dict[int, str]],
    path: Path,
) -> None:
    """Trace a module, which is switched to evaluation mode, and write it with float16 weights.

    Args:
        inputs: example inputs by name, in the order of the module's arguments.
        outputs: names of the outputs and their dynamic axes.
        dynamic: dynamic axes of the inputs.
        path: ONNX file to write.
    """
    module.eval()
    with atomic_path(path) as temporary:
        with warnings.catch_warnings():
            # The tracing exporter is deprecated, but it needs no further package and supports our axis names.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                module,
                tuple(inputs.values()),
                str(temporary),
                input_names=list(inputs),
                output_names=list(outputs),
                dynamic_axes={**dynamic, **outputs},
                opset_version=OPSET,
                dynamo=False,
            )
        model = store_as_half(onnx.load(str(temporary)))
        temporary.write_bytes(model.SerializeToString(deterministic=True))


def export_sam(encoder: sam.SamEncoder, decoder: sam.SamDecoder, folder: Path) -> None:
    """Write `config.json`, `preprocessor_config.json`, the two networks of SAM's layout and the preview."""
    vision, batch = _VisionEncoder(encoder).eval(), {0: "batch"}
    pixels = torch.zeros(1, 3, sam.FRAME_PX, sam.FRAME_PX)
    export_onnx(
        vision,
        {"pixel_values": pixels},
        {"image_embeddings": batch, "image_positional_embeddings": batch},
        {"pixel_values": batch},
        folder / "onnx" / "vision_encoder.onnx",
    )
    with torch.no_grad():
        place, shared = vision(pixels)
    inputs = {
        # Three prompts of two points each, because axes of length one would be traced as constants.
        "input_points": torch.full((2, 3, 2, 2), sam.FRAME_PX / 2.0),
        "input_labels": torch.ones((2, 3, 2), dtype=torch.int64),
        "image_embeddings": place.repeat(2, 1, 1, 1),
        "image_positional_embeddings": shared.repeat(2, 1, 1, 1),
    }
    prompts, points = {0: "batch", 1: "prompts"}, {0: "batch", 1: "prompts", 2: "points"}
    outputs = {"iou_scores": prompts, "pred_masks": prompts}
    dynamic = dict(zip(inputs, (points, points, batch, batch), strict=True))
    for name in (DECODER, PREVIEW):
        network = _MaskDecoder(decoder, preview=name == PREVIEW)
        export_onnx(network, inputs, outputs, dynamic, folder / "onnx" / f"{name}.onnx")
    config = {
        "model_type": "sam",
        "architectures": ["TinySam"],
        "image_size": sam.FRAME_PX,
        "mask_size": sam.FRAME_PX // sam.MASK_STRIDE,
        "num_multimask_outputs": 3,
        "world_only": True,
        OWN: vars(OWN_THRESHOLDS),
    }
    write_json(folder / "config.json", config)
    size: dict[str, Any] = {"size": {"longest_edge": sam.FRAME_PX}, "resample": 2}
    pad = {"do_pad": True, "pad_size": {"height": sam.FRAME_PX, "width": sam.FRAME_PX}}
    preprocessor = {"image_processor_type": "SamImageProcessor", **RGB, **size, **SCALING, **pad}
    write_json(folder / "preprocessor_config.json", preprocessor)


def export_clip(clip: Clip, folder: Path) -> None:
    """Write the configuration, `tokenizer.json` and the two networks of CLIP's layout."""
    batch, words = {0: "batch"}, {0: "batch", 1: "words"}
    export_onnx(
        clip.vision,
        {"pixel_values": torch.zeros(2, 3, CROP_PX, CROP_PX)},
        {"image_embeds": batch},
        {"pixel_values": batch},
        folder / "onnx" / "vision_model.onnx",
    )
    ones = torch.ones(2, 3, dtype=torch.int64)
    export_onnx(
        clip.text,
        {"input_ids": ones, "attention_mask": ones.clone()},
        {"text_embeds": batch},
        {"input_ids": words, "attention_mask": words},
        folder / "onnx" / "text_model.onnx",
    )
    with atomic_path(folder / "tokenizer.json") as temporary:
        temporary.write_text(clip.tokenizer.to_str(pretty=False) + "\n", encoding="utf-8")
    config = {"model_type": "clip", "architectures": ["TinyClip"], "projection_dim": DIMENSIONS}
    write_json(folder / "config.json", config | {"world_only": True})
    side = {"height": CROP_PX, "width": CROP_PX}
    size: dict[str, Any] = {"size": {"shortest_edge": CROP_PX}, "resample": 2}
    size |= {"do_center_crop": True, "crop_size": side}
    preprocessor = {"image_processor_type": "CLIPImageProcessor", **RGB, **size, **SCALING}
    write_json(folder / "preprocessor_config.json", preprocessor)
