"""Errors for a model folder that is incomplete, damaged or of another kind."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.models.layouts import NetworkSpec
from hilsplat.models.network import Network, require_one_space
from hilsplat.segment.sam import SamModel
from tests.conftest import PROJECT
from tests.unit.segment.handmade import save_network

ENCODER, CONFIG, PREPROCESSOR = "onnx/vision_encoder.onnx", "config.json", "preprocessor_config.json"
DECODER = "onnx/prompt_encoder_mask_decoder.onnx"
SAM = {"model_type": "sam"}
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 2548000000\n"


def written(name: str, content: object) -> Callable[[Path], object]:
    """Return a function that replaces a file of a folder by these bytes or this JSON value."""
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    return lambda folder: (folder / name).write_bytes(data)


def as_torch(folder: Path) -> None:
    shutil.rmtree(folder / "onnx")
    (folder / "model.safetensors").touch()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shutil.rmtree, r"is missing(.|\n)*masks.segmenter: graph, which needs no model"),
        (lambda folder: (folder / ENCODER).unlink(), "lacks onnx/vision_encoder.onnx"),
        (as_torch, r"PyTorch weights(.|\n)*hilsplat models get(.|\n)*docs/models.md"),
        (written(ENCODER, b""), r"cannot be opened(.|\n)*a file of 0 bytes"),
        (written(ENCODER, b"half"), r"encoder.onnx cannot be opened(.|\n)*fetch a complete copy"),
        (written(ENCODER, LFS_POINTER), r"Git LFS pointer(.|\n)*git lfs pull"),
        (written(DECODER, b"half"), r"decoder.onnx cannot be opened(.|\n)*fetch a complete copy"),
        (written(CONFIG, b"{"), r"no readable config.json(.|\n)*not valid JSON(.|\n)*fetch a complete copy"),
        (written(CONFIG, []), r"a different kind of model(.|\n)*model_type"),
        (written(CONFIG, {"model_type": "sam3"}), r"SAM 2 or 2.1 \(sam2\)(.|\n)*sam3(.|\n)*use SAM 2.1"),
        (written(CONFIG, {"model_type": "blip"}), r"SAM 2 or 2.1 \(sam2\)(.|\n)*blip(.|\n)*docs/models.md"),
        (written(CONFIG, SAM | {"mask_generation": {"stability_min": 3}}), "mask_generation is invalid"),
        (written(CONFIG, SAM | {"mask_generation": {"segmenter": "graph"}}), "mask_generation is invalid"),
        (written(CONFIG, SAM | {"mask_generation": [1]}), "mask_generation is invalid"),
        (
            written(CONFIG, SAM | {"vision_config": {"num_attention_heads": "12"}}),
            "vision_config cannot be re",
        ),
        (written(CONFIG, SAM | {"vision_config": {"backbone_config": 3}}), "vision_config cannot be read"),
        (written(PREPROCESSOR, {"do_normalize": False}), "disables do_normalize"),
        (written(PREPROCESSOR, {"image_std": [0, 1, 1]}), "image_std is invalid"),
    ],
)
def test_incomplete_damaged_and_unsupported_folders_are_refused(own_sam, change, words):
    change(own_sam)
    with pytest.raises(ModelError, match=words):
        SamModel.load(own_sam)


@pytest.mark.parametrize("vision", [{"patch_size": 0}, {"image_size": "1024"}, {"global_attn_indexes": 3}])
def test_an_encoder_that_differs_from_its_configuration_runs_as_exported(own_sam, caplog, vision):
    written(CONFIG, SAM | {"vision_config": vision})(own_sam)
    assert SamModel.load(own_sam).as_exported
    assert "vision_encoder.onnx runs as exported" in caplog.text


SPEC = NetworkSpec({"x": (None, None)}, {"y": (None, 3)})


@pytest.mark.parametrize(
    ("given", "result", "operator", "words"),
    [
        ("float[a,b] z", "float[a,b] y", "Identity (z)", "unexpected or missing inputs: x, z"),
        ("uint8[a,b] x", "float[a,b] y", "Cast <to = 1> (x)", r"inputs: x(.|\n)*tensor\(uint8\)"),
        ("float[4] x", "float[4] y", "Identity (x)", r"inputs: x(.|\n)*\(any, any\)(.|\n)*\[4\]"),
        ("float[a,4] x", "float[a,4] y", "Identity (x)", r"outputs: y\n  expected  y \(any, 3\)"),
    ],
)
def test_networks_with_other_inputs_or_outputs_are_refused(tmp_path, given, result, operator, words):
    save_network(tmp_path / "network.onnx", f"network ({given}) => ({result}) {{ y = {operator} }}")
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


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_decoder_whose_ious_are_not_numbers_is_named(disc_sam, monkeypatch, value):
    model = SamModel.load(disc_sam)
    encoded = model.encode(np.zeros((16, 16, 3), np.uint8))
    iou, logits = model.decode(encoded, np.full((2, 2), 8.0))
    monkeypatch.setattr(model, "factored", None)
    monkeypatch.setattr(model, "decoder", lambda *_: (np.full_like(iou, value), logits))
    with pytest.raises(ModelError, match=r"predicts 6 IoUs of 6 that are not finite(.|\n)*masks.variant"):
        model.decode(encoded, np.full((2, 2), 8.0))


@pytest.mark.parametrize("content", ["", "raise ImportError('libonnxruntime.so.1: cannot open')"])
def test_an_onnxruntime_that_lost_its_files_is_named(tmp_path, content):
    (tmp_path / "onnxruntime").mkdir()
    (tmp_path / "onnxruntime/__init__.py").write_text(content)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{PROJECT}"}
    words = [sys.executable, "-c", "import hilsplat.models.network"]
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert "ModelError: onnxruntime cannot be imported" in done.stderr
    assert "--force-reinstall onnxruntime" in done.stderr
