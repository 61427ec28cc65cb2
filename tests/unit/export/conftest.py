"""Small SAM and CLIP models of transformers with random weights, and their ONNX exports by optimum."""

import json
import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.published_models.exports import Call, enliven, export_sam, export_sam2, small_sam2, trace

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")

WORDS = ("re", "red</w>", "mu", "mug</w>")
SMALL = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
MERGES = ("r e", "re d</w>", "m u", "mu g</w>")


@pytest.fixture(scope="session")
def transformers():
    return pytest.importorskip("transformers", reason="needs the extra export")


def export(folder: Path, out: Path) -> Path:
    """`optimum-cli export onnx --model folder out`."""
    exporters = pytest.importorskip("optimum.exporters.onnx", reason="needs the extra export")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's tracer, about the exporter's own code
        exporters.main_export(str(folder), output=out, task="feature-extraction", do_validation=False)
    return out


@pytest.fixture(scope="session")
def sam_parts(transformers, tmp_path_factory):
    """A SAM for images of 64 px: transformers' model, its processor, and its exported folder."""
    folder = tmp_path_factory.mktemp("sam")
    sizes = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_dim": 32}
    image = {"image_size": 64, "patch_size": 8}
    attention = {"window_size": 4, "global_attn_indexes": [1], "num_pos_feats": 8}
    config = transformers.SamConfig(
        {**sizes, **image, **attention, "output_channels": 16},
        {"hidden_size": 16, **image, "mask_input_channels": 4},
        {**sizes, "iou_head_hidden_dim": 16},
    )
    model = transformers.SamModel._from_config(config, attn_implementation="eager").eval()
    enliven(model)
    images = transformers.SamImageProcessor(
        size={"longest_edge": 64},
        pad_size={"height": 64, "width": 64},
        mask_size={"longest_edge": 16},
        mask_pad_size={"height": 16, "width": 16},
    )
    processor = transformers.SamProcessor(images)
    processor.target_size = 64  # the processor of a model of 1024 px is the same with 1024
    export_sam(model, folder / "export")
    images.save_pretrained(folder / "export")
    return model, processor, folder / "export"


@pytest.fixture(scope="session")
def clip_parts(transformers, tmp_path_factory):
    """A CLIP for crops of 32 px and texts of 16 tokens, as `sam_parts`; its export is one `model.onnx`."""
    from transformers.models.clip.tokenization_clip import bytes_to_unicode

    folder = tmp_path_factory.mktemp("clip")
    letters = list(bytes_to_unicode().values())
    words = [*letters, *(f"{letter}</w>" for letter in letters), *WORDS, "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *MERGES, ""]))
    tokenizer = transformers.CLIPTokenizerFast(
        str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=16
    )
    begin, end = len(words) - 2, len(words) - 1
    tokens = {"bos_token_id": begin, "eos_token_id": end, "pad_token_id": end}
    config = transformers.CLIPConfig(
        {"vocab_size": len(words), "max_position_embeddings": 16, **tokens, **SMALL},
        {"image_size": 32, "patch_size": 8, **SMALL},
        projection_dim=12,
    )
    model = transformers.CLIPModel(config).eval()
    enliven(model)
    images = transformers.CLIPImageProcessor(
        size={"shortest_edge": 32}, crop_size={"height": 32, "width": 32}
    )
    processor = transformers.CLIPProcessor(images, tokenizer)
    model.save_pretrained(folder / "torch")
    processor.save_pretrained(folder / "torch")
    return model, processor, export(folder / "torch", folder / "export")


@pytest.fixture(scope="session")
def photograph() -> np.ndarray:
    """A wide image with regions, slopes and noise."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[:60, :100]
    image = np.stack([2.5 * x, 4 * y, 128 + 100 * np.sin(x / 9) * np.cos(y / 7)], axis=2)
    image[10:40, 20:50] = (200, 40, 90)
    return np.clip(image + generator.normal(0, 8, image.shape), 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def sam2_parts(transformers, tmp_path_factory):
    """A SAM 2 for images of 64 px: transformers' model, and its folder with the published signature."""
    model, folder = small_sam2(), tmp_path_factory.mktemp("sam2")
    enliven(model)
    export_sam2(model, folder)
    return model, folder


@pytest.fixture(scope="session")
def siglip_parts(transformers, tmp_path_factory):
    """A SigLIP for crops of 32 px: transformers' model, its folder with the names of transformers.js, and its
    single network by optimum."""
    from tokenizers import Tokenizer, models, pre_tokenizers, processors

    folder = tmp_path_factory.mktemp("siglip")
    config = transformers.SiglipConfig(
        {"vocab_size": 8, "max_position_embeddings": 64, **SMALL},
        {"image_size": 32, "patch_size": 8, **SMALL},
    )
    model = transformers.SiglipModel(config).eval()
    enliven(model)
    words = {"<unk>": 0, "red": 1, "mug": 2, "on": 3, "</s>": 4}
    tokenizer = Tokenizer(models.WordLevel(words, "<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing("$A </s>", special_tokens=[("</s>", 4)])
    images = transformers.SiglipImageProcessor(size={"height": 32, "width": 32})
    for place in (folder / "js", folder / "optimum"):
        place.mkdir()
        tokenizer.save(str(place / "tokenizer.json"))
        (place / "tokenizer_config.json").write_text(json.dumps({"pad_token": "</s>"}))
        images.save_pretrained(place)
        config.save_pretrained(place)
    output = ["last_hidden_state", "pooler_output"]
    batch = {name: {0: "batch"} for name in ("pixel_values", "input_ids", *output)}
    for name, part, inputs in (
        ("vision_model", model.vision_model, {"pixel_values": torch.zeros(2, 3, 32, 32)}),
        ("text_model", model.text_model, {"input_ids": torch.ones((2, 64), dtype=torch.int64)}),
    ):
        wrapped = Call(part, lambda value, part=part: tuple(part(value).to_tuple()[:2]))
        trace(wrapped, inputs, output, batch, folder / f"js/onnx/{name}.onnx")

    def whole(ids, pixels):
        found = model(input_ids=ids, pixel_values=pixels)
        return found.text_embeds, found.image_embeds

    inputs = {"input_ids": torch.ones((2, 64), dtype=torch.int64), "pixel_values": torch.zeros(2, 3, 32, 32)}
    vectors = ["text_embeds", "image_embeds"]
    batch = {name: {0: "batch"} for name in (*inputs, *vectors)}
    trace(Call(model, whole), inputs, vectors, batch, folder / "optimum/model.onnx")
    return model, images, folder


@pytest.fixture
def open_clip_folder(clip_parts, tmp_path):
    """The CLIP of `clip_parts` in open_clip's two folders, with one picture and one text per call."""
    model, processor, exported = clip_parts
    folder = tmp_path / "open_clip"
    visual = Call(model, lambda image: torch.nn.functional.normalize(model.get_image_features(image)))
    trace(visual, {"image": torch.zeros(1, 3, 32, 32)}, ["embedding"], {}, folder / "visual/model.onnx")
    textual = Call(model, lambda text: torch.nn.functional.normalize(model.get_text_features(text)))
    ids = torch.full((1, 16), model.config.text_config.eos_token_id, dtype=torch.int32)
    trace(textual, {"text": ids}, ["embedding"], {}, folder / "textual/model.onnx")
    for name in ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json"):
        shutil.copy(exported / name, folder / "textual" / name)
    config = {"embed_dim": 12, "vision_cfg": {"image_size": 32, "patch_size": 8}, "text_cfg": {}}
    (folder / "config.json").write_text(json.dumps(config))
    images = processor.image_processor
    preprocessing = {"size": [32, 32], "mean": images.image_mean, "std": images.image_std}
    preprocessing["interpolation"] = "bicubic"
    (folder / "visual/preprocess_cfg.json").write_text(json.dumps(preprocessing))
    return folder
