"""SAM and CLIP of the transformers library with small configurations and random weights, and their real
ONNX exports by optimum: what a user downloads or exports, without any download."""

import json
import os
import warnings
from pathlib import Path

import numpy as np
import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("TRANSFORMERS_VERBOSITY", "error")

WORDS = ("re", "red</w>", "mu", "mug</w>")
MERGES = ("r e", "re d</w>", "m u", "mu g</w>")


def export(folder: Path, out: Path) -> Path:
    """`optimum-cli export onnx --model folder out`."""
    exporters = pytest.importorskip("optimum.exporters.onnx", reason="needs the extra export")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch's tracer, about the exporter's own code
        exporters.main_export(str(folder), output=out, task="feature-extraction", do_validation=False)
    return out


def enliven(model) -> None:
    """Replace the tiny initial weights, whose outputs would hardly depend on the inputs."""
    import torch

    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(0, 1.6 / parameter[0].numel() ** 0.5, generator=generator)


@pytest.fixture(scope="session")
def sam_parts(tmp_path_factory):
    """A SAM for images of 64 px: transformers' model, its processor, and its exported folder."""
    transformers = pytest.importorskip("transformers", reason="needs the extra export")
    folder = tmp_path_factory.mktemp("sam")
    vision = transformers.SamVisionConfig(
        hidden_size=16,
        output_channels=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=64,
        patch_size=8,
        window_size=4,
        global_attn_indexes=[1],
        mlp_dim=32,
        num_pos_feats=8,
    )
    prompt = transformers.SamPromptEncoderConfig(
        hidden_size=16, image_size=64, patch_size=8, mask_input_channels=4
    )
    decoder = transformers.SamMaskDecoderConfig(
        hidden_size=16, num_hidden_layers=2, num_attention_heads=2, mlp_dim=32, iou_head_hidden_dim=16
    )
    config = transformers.SamConfig(vision.to_dict(), prompt.to_dict(), decoder.to_dict())
    model = transformers.SamModel(config).eval()
    enliven(model)
    images = transformers.SamImageProcessor(
        size={"longest_edge": 64},
        pad_size={"height": 64, "width": 64},
        mask_size={"longest_edge": 16},
        mask_pad_size={"height": 16, "width": 16},
    )
    processor = transformers.SamProcessor(images)
    processor.target_size = 64  # the processor of a model of 1024 px is the same with 1024
    model.save_pretrained(folder / "torch")
    images.save_pretrained(folder / "torch")
    return model, processor, export(folder / "torch", folder / "export")


@pytest.fixture(scope="session")
def clip_parts(tmp_path_factory):
    """A CLIP for crops of 32 px and texts of 16 tokens, as `sam_parts`; its export is one `model.onnx`."""
    transformers = pytest.importorskip("transformers", reason="needs the extra export")
    from transformers.models.clip.tokenization_clip import bytes_to_unicode

    folder = tmp_path_factory.mktemp("clip")
    letters = list(bytes_to_unicode().values())
    words = [*letters, *(f"{letter}</w>" for letter in letters), *WORDS, "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({word: number for number, word in enumerate(words)}))
    (folder / "merges.txt").write_text("\n".join(["#version: 0.2", *MERGES, ""]))
    tokenizer = transformers.CLIPTokenizerFast(
        str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=16
    )
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = transformers.CLIPTextConfig(
        vocab_size=len(words),
        max_position_embeddings=16,
        bos_token_id=len(words) - 2,
        eos_token_id=len(words) - 1,
        pad_token_id=len(words) - 1,
        **small,
    )
    vision = transformers.CLIPVisionConfig(image_size=32, patch_size=8, **small)
    config = transformers.CLIPConfig(text.to_dict(), vision.to_dict(), projection_dim=12)
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
