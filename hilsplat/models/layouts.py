"""Layouts of published ONNX exports of SAM and CLIP: files, inputs and outputs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

Axes = tuple[int | None, ...]  # axis lengths of an array; None where the layout does not fix the length


@dataclass(frozen=True)
class NetworkSpec:
    """Inputs and outputs of one network of a model, by name."""

    inputs: Mapping[str, Axes]  # required inputs
    outputs: Mapping[str, Axes]  # required outputs; others are ignored
    optional: tuple[str, ...] = ()  # inputs that are passed if the network has them
    places: tuple[str, ...] = ()  # paths in the folder, without `.onnx`; the first that exists is used
    synonyms: Mapping[str, str] = field(default_factory=dict)  # output -> alternative name in some exports


@dataclass(frozen=True)
class Layout:
    """Networks and file names of a kind of model."""

    kind: str  # "sam" for segmentation, "clip" for comparing images with texts
    networks: Mapping[str, NetworkSpec]  # required networks, by the names used in this package
    further: Mapping[str, NetworkSpec] = field(default_factory=dict)  # used if the folder contains them
    preprocessing: str = "preprocessor_config.json"
    tokenizer: str = ""  # empty if the model does not process texts
    beside: tuple[str, ...] = ()  # further files that are included in the digest if they exist

    @property
    def usable(self) -> dict[str, NetworkSpec]:
        """Required and optional networks."""
        return {**self.networks, **self.further}

    @property
    def described(self) -> tuple[str, ...]:
        """Files required in addition to the networks."""
        return ("config.json", self.preprocessing, *([self.tokenizer] if self.tokenizer else []))


_ANY2, _ANY4 = (None,) * 2, (None,) * 4
_IMAGE: Axes = (None, 3, None, None)
_POINTS: dict[str, Axes] = {"input_points": (None, None, None, 2)}
_MASKS: dict[str, Axes] = {"iou_scores": (None, None, 3), "pred_masks": (None, None, 3, None, None)}

DECODER = "prompt_encoder_mask_decoder"
PREVIEW = "prompt_encoder_mask_preview"
"""A decoder with the same predicted IoUs, but only every second row and column of the masks. It is used
to detect duplicate prompts in a fraction of the decoder's time (`segment.generate`). sam-tiny has one."""


def _places(name: str) -> tuple[str, ...]:
    return name, f"onnx/{name}"


def _segmenter(features: Sequence[str]) -> Layout:
    """Return the layout of a SAM model whose encoder passes the named features to its decoder."""
    encoded = dict.fromkeys(features, _ANY4)
    encoder = NetworkSpec({"pixel_values": _IMAGE}, encoded, (), _places("vision_encoder"))
    decoder, preview = (
        NetworkSpec(_POINTS | encoded, _MASKS, ("input_labels", "input_boxes"), _places(name))
        for name in (DECODER, PREVIEW)
    )
    return Layout("sam", {"vision_encoder": encoder, DECODER: decoder}, {PREVIEW: preview})


def _image_and_text(image: str, text: str, optional: tuple[str, ...] = ()) -> Layout:
    """Return the layout of a Hugging Face CLIP export whose vectors have the given output names."""
    vision = NetworkSpec(
        {"pixel_values": _IMAGE}, {image: _ANY2}, (), _places("vision_model"), {image: "image_embeds"}
    )
    texts = NetworkSpec(
        {"input_ids": _ANY2}, {text: _ANY2}, optional, _places("text_model"), {text: "text_embeds"}
    )
    return Layout(
        "clip",
        {"vision_model": vision, "text_model": texts},
        tokenizer="tokenizer.json",
        beside=("tokenizer_config.json", "special_tokens_map.json"),
    )


LAYOUTS: dict[str, Layout] = {
    "sam": _segmenter(("image_embeddings", "image_positional_embeddings")),
    "sam2": _segmenter(tuple(f"image_embeddings.{level}" for level in range(3))),
    "clip": _image_and_text("image_embeds", "text_embeds", ("attention_mask",)),
    "siglip": _image_and_text("pooler_output", "pooler_output"),
    "open_clip": Layout(
        "clip",
        {
            "vision_model": NetworkSpec({"image": _IMAGE}, {"embedding": _ANY2}, (), ("visual/model",)),
            "text_model": NetworkSpec({"text": _ANY2}, {"embedding": _ANY2}, (), ("textual/model",)),
        },
        preprocessing="visual/preprocess_cfg.json",
        tokenizer="textual/tokenizer.json",
        beside=("textual/tokenizer_config.json", "textual/special_tokens_map.json"),
    ),
}
"""Supported layouts: SAM, SAM 2 and 2.1, CLIP and SigLIP with the file names of transformers.js and optimum,
and open_clip's two folders, as published by Immich."""

MODEL_TYPES = {
    "sam": "sam",
    **dict.fromkeys(("sam2", "sam2_video", "edgetam", "edgetam_video"), "sam2"),
    "clip": "clip",
    "siglip": "siglip",
}
"""`model_type` in config.json -> layout. open_clip has `vision_cfg` and `text_cfg` instead."""


def layout_of(config: object) -> str | None:
    """Return a model's layout from the contents of its config.json, or None if it is not supported."""
    if not isinstance(config, dict):
        return None
    if {"vision_cfg", "text_cfg"} <= config.keys():
        return "open_clip"
    model_type = config.get("model_type")
    return MODEL_TYPES.get(model_type) if isinstance(model_type, str) else None


SUPPORTED = {
    "sam": "SAM (model_type sam), SAM 2 or 2.1 (sam2), EdgeTAM (edgetam)",
    "clip": "CLIP (model_type clip), SigLIP or SigLIP 2 of fixed resolution (siglip), open_clip (folders "
    "visual/ and textual/)",
}
"""Supported models by kind, for messages."""

OTHER_TYPES = {
    "siglip2": "this SigLIP 2 model has variable resolution (NaFlex); use one of fixed resolution, such as "
    "siglip2-base-patch16-224",
    "sam_hq": "use SAM or SAM 2.1",
    "sam3": "use SAM 2.1",
    "sam3_tracker": "use SAM 2.1",
    "chinese_clip": "use CLIP, SigLIP 2 (many languages) or an open_clip model in two folders",
}
"""Unsupported `model_type` -> which model to use instead."""

SECTIONS = {"sam": "masks", "clip": "clip"}  # settings section that selects the model, by kind
TORCH_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth")  # suffixes of PyTorch weight files
