"""Errors for a model folder that is incomplete, damaged or of another kind."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.models.layouts import NetworkSpec
from hilsplat.models.network import Network, require_one_space
from hilsplat.segment.sam import SamModel
from tests.unit.segment.handmade import save_network

ENCODER, CONFIG, PREPROCESSOR = "onnx/vision_encoder.onnx", "config.json", "preprocessor_config.json"
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 2548000000\n"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (ENCODER, b"", r"cannot be opened(.|\n)*a file of 0 bytes"),
        (ENCODER, b"half of a network", r"vision_encoder.onnx cannot be opened(.|\n)*fetch a complete copy"),
        (ENCODER, LFS_POINTER, r"Git LFS pointer(.|\n)*git lfs pull"),
        (CONFIG, b"{", r"no readable config.json(.|\n)*model_type"),
        (CONFIG, b"[]", r"a different kind of model(.|\n)*model_type"),
        (CONFIG, b'{"model_type": 3}', r"a different kind of model(.|\n)*model_type"),
        (CONFIG, b'{"model_type": "sam3"}', r"SAM 2 or 2.1 \(sam2\)(.|\n)*sam3(.|\n)*use SAM 2.1"),
        (CONFIG, b'{"model_type": "blip"}', r"SAM 2 or 2.1 \(sam2\)(.|\n)*blip(.|\n)*docs/models.md"),
    ],
)
def test_damaged_or_unsupported_files_are_refused(own_sam, name, content, words):
    (own_sam / name).write_bytes(content)
    with pytest.raises(ModelError, match=words):
        SamModel.load(own_sam)


@pytest.mark.parametrize(
    ("name", "entry", "words"),
    [
        (PREPROCESSOR, {"do_normalize": False}, "disables do_normalize"),
        (PREPROCESSOR, {"image_std": [0, 1, 1]}, "image_std is invalid"),
        (PREPROCESSOR, {"image_std": "x"}, "image_std is invalid"),
        (PREPROCESSOR, {"image_mean": [1e999, 0, 0]}, "image_mean is invalid"),
        (CONFIG, {"mask_generation": {"stability_min": 3}}, "config.json: mask_generation is invalid"),
        (CONFIG, {"mask_generation": {"segmenter": "graph"}}, "config.json: mask_generation is invalid"),
        (CONFIG, {"mask_generation": [1]}, "config.json: mask_generation is invalid"),
    ],
)
def test_configuration_that_cannot_be_used_is_refused(own_sam, name, entry, words):
    (own_sam / name).write_text(json.dumps(json.loads((own_sam / name).read_text()) | entry))
    with pytest.raises(ModelError, match=words):
        SamModel.load(own_sam)


def as_variant(folder: Path) -> None:
    (folder / ENCODER).rename(folder / "onnx" / "vision_encoder_quantized.onnx")


def as_torch(folder: Path) -> None:
    shutil.rmtree(folder / "onnx")
    (folder / "model.safetensors").touch()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shutil.rmtree, r"is missing(.|\n)*masks.segmenter: graph, which needs no model"),
        (as_variant, r"lacks onnx/vision_encoder.onnx(.|\n)*vision_encoder_quantized.onnx"),
        (as_torch, r"PyTorch weights(.|\n)*hilsplat models get(.|\n)*docs/models.md"),
    ],
)
def test_missing_networks_are_refused(own_sam, change: Callable[[Path], None], words):
    change(own_sam)
    with pytest.raises(ModelError, match=words):
        SamModel.load(own_sam)


SPEC = NetworkSpec({"x": (None, None)}, {"y": (None, 3)})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("same (float[a,b] z) => (float[a,b] y) { y = Identity (z) }", "unexpected or missing inputs: x, z"),
        (
            "cast (uint8[a,b] x) => (float[a,b] y) { y = Cast <to = 1> (x) }",
            r"inputs: x(.|\n)*tensor\(uint8\)",
        ),
        (
            "same (float[4] x) => (float[4] y) { y = Identity (x) }",
            r"inputs: x(.|\n)*\(any, any\)(.|\n)*\[4\]",
        ),
        (
            "same (float[a,4] x) => (float[a,4] y) { y = Identity (x) }",
            r"unexpected or missing outputs: y\n  expected  y \(any, 3\)(.|\n)*'a', 4\]",
        ),
    ],
)
def test_networks_with_other_inputs_or_outputs_are_refused(tmp_path, text, words):
    save_network(tmp_path / "network.onnx", text)
    with pytest.raises(ModelError, match=words):
        Network(tmp_path / "network.onnx", SPEC)


def test_networks_with_undeclared_shapes_are_checked_when_they_run(tmp_path):
    path = tmp_path / "network.onnx"
    save_network(path, "same (float[a,b] x) => (float[a,b] y) { y = Identity (x) }")
    network = Network(path, SPEC)
    network(x=np.zeros((1, 3)))
    with pytest.raises(ModelError, match=r"returned y of shape \(1, 4\)\n  expected  y \(any, 3\)"):
        network(x=np.zeros((1, 4)))
    require_one_space(tmp_path, 512, None)
    with pytest.raises(ModelError, match=r"do not belong together(.|\n)*512(.|\n)*768"):
        require_one_space(tmp_path, 512, 768)
