"""SAM models of transformers with random weights, exported with the signatures of the published files.

docs/models.md lists the published models and what is known of their signatures.
"""

import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import onnx
import torch
from torch import nn

EMBEDDINGS = [f"image_embeddings.{level}" for level in range(3)]
DECODER = "prompt_encoder_mask_decoder.onnx"
ENCODER = "vision_encoder.onnx"


def enliven(module: nn.Module) -> None:
    """Replace the initial weights, with which the outputs would be almost constant.

    Norms get different scales, because exporters merge equal weights. SAM's positional frequencies are a
    buffer that transformers draws again for every model.
    """
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            if parameter.ndim > 1:
                parameter.normal_(0, 1.6 / parameter[0].numel() ** 0.5, generator=generator)
            else:
                parameter.normal_(float(parameter.mean()), 0.02, generator=generator)
        for name, buffer in module.named_buffers():
            if name.endswith("positional_embedding"):
                buffer.normal_(generator=generator)


class Call(nn.Module):
    """A function of a model as a module."""

    def __init__(self, model: nn.Module, function: Callable) -> None:
        super().__init__()
        self.model = model
        self.function = function

    def forward(self, *inputs: torch.Tensor) -> object:
        return self.function(*inputs)


def trace(
    module: nn.Module,
    inputs: Mapping[str, torch.Tensor],
    outputs: list[str],
    dynamic: Mapping[str, Mapping[int, str]],
    path: Path,
    opset: int = 18,
    dynamo: bool = False,
) -> None:
    """Export a module by `torch.onnx.export`, by default with the TorchScript exporter."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module.eval(),
            tuple(inputs.values()),
            str(path),
            input_names=list(inputs),
            output_names=outputs,
            opset_version=opset,
            dynamo=dynamo,
            **({"dynamic_shapes": dynamic_shapes(inputs, dynamic)} if dynamo else {"dynamic_axes": dynamic}),
        )


def dynamic_shapes(
    inputs: Mapping[str, torch.Tensor], dynamic: Mapping[str, Mapping[int, str]]
) -> tuple[tuple[dict[int, object], ...]]:
    """Return the free axes in the form that the dynamo exporter requires, for a module of `*inputs`."""
    return (tuple(dict.fromkeys(dynamic.get(name, {}), torch.export.Dim.AUTO) for name in inputs),)


def slim(path: Path) -> None:
    """Optimise a network with onnxslim, as the published conversion scripts do."""
    import onnxslim

    onnx.save(onnxslim.slim(str(path)), str(path))


def move_weights(path: Path) -> None:
    """Move weights of at least 1 KiB to `<network>.onnx_data` beside the network."""
    model = onnx.load(str(path))
    path.unlink()
    onnx.save(model, str(path), save_as_external_data=True, location=f"{path.name}_data")


def export_sam(model: nn.Module, folder: Path) -> None:
    """Export a SAM as published: by optimum at opset 13, which requires eager attention."""
    from optimum.exporters.onnx import onnx_export_from_model

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        onnx_export_from_model(
            model, folder, opset=13, task="feature-extraction", do_validation=False, model_kwargs=None
        )
    model.config.save_pretrained(folder)


def export_sam_decoder_without_labels(model: nn.Module, path: Path) -> None:
    """Export a SAM decoder without an input for labels, as optimum did until January 2024."""

    def decode(points, embeddings, positions):  # type: ignore[no-untyped-def]
        sparse, dense = model.prompt_encoder(points, torch.ones_like(points[..., 0]).long(), None, None)
        masks, scores = model.mask_decoder(embeddings, positions, sparse, dense, multimask_output=True)[:2]
        return scores, masks

    side = model.config.vision_config.image_size // model.config.vision_config.patch_size
    features = torch.randn(1, model.config.vision_config.output_channels, side, side)
    inputs = {
        "input_points": torch.full((1, 3, 2, 2), 32.0),
        "image_embeddings": features,
        "image_positional_embeddings": features.clone(),
    }
    dynamic = {"input_points": {0: "batch_size", 1: "point_batch_size", 2: "nb_points_per_image"}}
    trace(Call(model, decode), inputs, ["iou_scores", "pred_masks"], dynamic, path, opset=13)


def sam2_model(config: object) -> Any:
    import transformers

    torch.manual_seed(0)
    return transformers.Sam2Model(config).eval()


def small_sam2() -> Any:
    """A SAM 2 for images of 64 px."""
    import transformers

    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        image_size=[64, 64],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 2, 4, 8],
        window_size_per_stage=[8, 4, 4, 2],
        global_attention_blocks=[3],
        window_positional_embedding_background_size=[4, 4],
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
        fpn_hidden_size=16,
    )
    prompts = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
    decoder = {"hidden_size": 16, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16}
    return sam2_model(transformers.Sam2Config(vision, prompts, decoder))


def full_sam2() -> Any:
    """SAM 2.1 small at its published size."""
    import transformers

    backbone = transformers.Sam2HieraDetConfig(
        blocks_per_stage=[1, 2, 11, 2],
        global_attention_blocks=[7, 10, 13],
        window_positional_embedding_background_size=[7, 7],
    )
    return sam2_model(transformers.Sam2Config(transformers.Sam2VisionConfig(backbone)))


def sam2_decoder(model: nn.Module) -> Callable:
    """Return SAM 2's decoder as a function of points, labels, boxes (or None) and image embeddings."""

    def decode(points, labels, boxes, *embeddings):  # type: ignore[no-untyped-def]
        sparse, dense = model.prompt_encoder(points, labels, boxes, None)
        positions = model.get_image_wide_positional_embeddings()
        masks, scores, _, object_scores = model.mask_decoder(
            image_embeddings=embeddings[2],
            image_positional_embeddings=positions.repeat(embeddings[2].shape[0], 1, 1, 1),
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            multimask_output=True,
            high_resolution_features=list(embeddings[:2]),
        )
        return scores, masks, object_scores

    return decode


def export_sam2_decoder(
    model: nn.Module, path: Path, *, dynamo: bool = False, fixed_points: bool = True
) -> None:
    """Export a SAM 2 decoder with the published signature: one prompt per image, points and boxes.

    Inputs are `input_points` (batch, 1, n, 2), `input_labels` (batch, 1, n) and `input_boxes` (batch, m, 4);
    without `fixed_points`, axis 1 is free.
    """
    channels = model.mask_decoder.hidden_size
    side = model.prompt_encoder.image_embedding_size[0]
    shapes = (channels // 8, 4 * side), (channels // 4, 2 * side), (channels, side)
    inputs = {
        "input_points": torch.full((1, 1, 2, 2), 32.0),
        "input_labels": torch.ones((1, 1, 2), dtype=torch.int64),
        "input_boxes": torch.tensor([[[1.0, 2.0, 30.0, 40.0]]]),
        **{
            name: torch.randn(1, depth, size, size)
            for name, (depth, size) in zip(EMBEDDINGS, shapes, strict=True)
        },
    }
    prompts = {0: "batch_size", 2: "num_points_per_image"} | ({} if fixed_points else {1: "prompts"})
    dynamic = {
        "input_points": prompts,
        "input_labels": prompts,
        "input_boxes": {0: "batch_size", 1: "num_boxes_per_image"},
        **{name: {0: "batch_size"} for name in EMBEDDINGS},
    }
    outputs = ["iou_scores", "pred_masks", "object_score_logits"]
    if dynamo:  # free axes of length 1 would be fixed
        inputs = {name: value.repeat(2, *[1] * (value.ndim - 1)) for name, value in inputs.items()}
    trace(Call(model, sam2_decoder(model)), inputs, outputs, dynamic, path, dynamo=dynamo)


def export_sam2(model: Any, folder: Path) -> None:
    """Export a SAM 2.1 as published: TorchScript, onnxslim, weights in separate files."""
    side_px = model.config.prompt_encoder_config.image_size
    pixels = torch.zeros(1, 3, side_px, side_px)
    encode = Call(model, lambda pixels: tuple(model.get_image_embeddings(pixels)))
    encoder, decoder = folder / "onnx" / ENCODER, folder / "onnx" / DECODER
    trace(encode, {"pixel_values": pixels}, EMBEDDINGS, {}, encoder)
    export_sam2_decoder(model, decoder)
    for path in (encoder, decoder):
        slim(path)
        move_weights(path)
    model.config.save_pretrained(folder)
    preprocessing = {
        "image_processor_type": "Sam2ImageProcessorFast",
        "size": {"height": side_px, "width": side_px},
        "image_mean": [0.485, 0.456, 0.406],
        "image_std": [0.229, 0.224, 0.225],
        "resample": 2,
        "pad_size": None,
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessing))


class EdgeTam(nn.Module):
    """The prompt encoder and mask decoder of EdgeTAM; its vision encoder requires timm and torchvision."""

    def __init__(self) -> None:
        from transformers.models.edgetam import configuration_edgetam as config
        from transformers.models.edgetam import modeling_edgetam as modeling

        super().__init__()
        torch.manual_seed(0)
        sizes = {"hidden_size": 16, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
        prompts = config.EdgeTamPromptEncoderConfig(**sizes)
        decoder = config.EdgeTamMaskDecoderConfig(
            hidden_size=16, mlp_dim=32, num_attention_heads=2, iou_head_hidden_dim=16
        )
        for each in (prompts, decoder):
            each._attn_implementation = "eager"
        self.prompt_encoder = modeling.EdgeTamPromptEncoder(prompts)
        self.mask_decoder = modeling.EdgeTamMaskDecoder(decoder)
        enliven(self)

    def get_image_wide_positional_embeddings(self) -> torch.Tensor:
        side = self.prompt_encoder.image_embedding_size[0]
        places = (torch.arange(side) + 0.5) / side
        grid = torch.stack(torch.meshgrid(places, places, indexing="xy"), dim=-1)
        return self.prompt_encoder.shared_embedding(grid).permute(2, 0, 1)[None]


def as_fp16(path: Path) -> None:
    """Convert a network to float16 with float32 inputs and outputs, as files with the suffix `_fp16`."""
    from onnxruntime.transformers.float16 import convert_float_to_float16

    onnx.save(convert_float_to_float16(onnx.load(str(path)), keep_io_types=True), str(path))


def as_int8(path: Path) -> None:
    """Quantise a network dynamically, as files with the suffix `_quantized`."""
    from onnxruntime.quantization import QuantType, quantize_dynamic

    quantize_dynamic(onnx.load(str(path)), str(path), weight_type=QuantType.QUInt8)


def as_q4(path: Path) -> None:
    """Quantise the products of a network in blocks of four bits, as files with the suffix `_q4`."""
    from onnxruntime.quantization.matmul_nbits_quantizer import MatMulNBitsQuantizer

    quantizer = MatMulNBitsQuantizer(onnx.load(str(path)), block_size=32, is_symmetric=True, bits=4)
    quantizer.process()
    onnx.save(quantizer.model.model, str(path))


def link(folder: Path, into: Path) -> Path:
    """Return a folder of links to the files of a model, as in the hub's cache: blobs and a snapshot."""
    linked = into / "snapshots" / folder.name
    blobs = into / "blobs"
    blobs.mkdir(parents=True)
    for number, file in enumerate(sorted(each for each in folder.rglob("*") if each.is_file())):
        place = linked / file.relative_to(folder)
        place.parent.mkdir(parents=True, exist_ok=True)
        (blobs / f"{number:040x}").write_bytes(file.read_bytes())
        place.symlink_to(Path(*[".."] * len(place.relative_to(into).parts[:-1]), "blobs", f"{number:040x}"))
    return linked


def declared_axes(path: Path) -> dict[str, list[int | str]]:
    """Return the axes of each input of a network: a length, or the name of a free axis."""
    model = onnx.load(str(path), load_external_data=False)
    return {
        each.name: [axis.dim_value or axis.dim_param for axis in each.type.tensor_type.shape.dim]
        for each in model.graph.input
    }
