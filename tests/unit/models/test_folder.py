"""What counts as a model's files, and what is said about folders that cannot be used."""

import json
import shutil

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from hilsplat.base.errors import ModelError
from hilsplat.models.clip_split import split_clip
from hilsplat.models.folder import external_weights, open_model_folder, variants_of
from hilsplat.segment.sam import SamModel
from tests.conftest import PROJECT

TINY = PROJECT / "models/sam-tiny"


@pytest.fixture
def sam(tmp_path):
    shutil.copytree(TINY, tmp_path / "sam")
    return tmp_path / "sam"


def outside(path, location: str) -> None:
    """Move a network's weights into a file of their own."""
    model = onnx.load(path)
    path.unlink()
    onnx.save(model, path, save_as_external_data=True, location=location, size_threshold=64)


@pytest.mark.parametrize("location", ["vision_encoder.onnx_data", "weights.bin", "onnx__MatMul_7"])
def test_the_digest_covers_weights_in_a_file_of_any_name(sam, location):
    outside(sam / "onnx/vision_encoder.onnx", location)
    model, weights = open_model_folder(sam), sam / "onnx" / location
    assert weights in model.files
    before = model.digest
    changed = bytearray(weights.read_bytes())
    changed[1000] ^= 1
    weights.write_bytes(changed)
    assert open_model_folder(sam).digest != before


def test_weights_of_constants_count_too(tmp_path):
    value = numpy_helper.from_array(np.ones(4096, np.float32), "value")
    nodes = [helper.make_node("Constant", [], ["y"], value=value)]
    graph = helper.make_graph(nodes, "g", [], [helper.make_tensor_value_info("y", TensorProto.FLOAT, [4096])])
    path = tmp_path / "constant.onnx"
    onnx.save(
        helper.make_model(graph),
        path,
        save_as_external_data=True,
        location="elsewhere",
        convert_attribute=True,
    )
    assert external_weights(path, tmp_path) == [tmp_path / "elsewhere"]


def test_weights_outside_the_folder_are_refused(sam):
    outside(sam / "onnx/vision_encoder.onnx", "weights.bin")
    path = sam / "onnx/vision_encoder.onnx"
    (sam / "onnx/weights.bin").rename(sam.parent / "weights.bin")
    (sam / "onnx/weights.bin").symlink_to(sam.parent / "weights.bin")
    with pytest.raises(ModelError, match=r"weights are missing(.|\n)*the file weights.bin beside it"):
        external_weights(path, sam)


def rename(folder, ending: str) -> None:
    for path in (folder / "onnx").glob("*.onnx"):
        path.rename(path.with_name(f"{path.stem}_{ending}.onnx"))


def test_a_variant_is_chosen_by_its_ending(sam):
    plain = open_model_folder(sam).digest
    rename(sam, "fp16")
    with pytest.raises(ModelError, match=r"come as variants: set masks.variant to one of 'fp16'"):
        SamModel.load(sam)
    model = SamModel.load(sam, "fp16")
    assert model.encoder.path.name == "vision_encoder_fp16.onnx"
    assert model.digest != plain


def test_variants_are_those_that_all_networks_have(sam):
    for ending in ("q4", "int8"):
        shutil.copy(sam / "onnx/vision_encoder.onnx", sam / f"onnx/vision_encoder_{ending}.onnx")
    decoder = sam / "onnx/prompt_encoder_mask_decoder.onnx"
    shutil.copy(decoder, decoder.with_name("prompt_encoder_mask_decoder_int8.onnx"))
    assert variants_of(sam, "sam") == ["", "int8"]
    with pytest.raises(ModelError, match=r"lacks onnx/prompt_encoder_mask_decoder_q4.onnx(.|\n)*'', 'int8'"):
        open_model_folder(sam, variant="q4")


def test_pytorch_weights_must_be_exported(sam):
    shutil.rmtree(sam / "onnx")
    (sam / "model.safetensors").touch()
    with pytest.raises(ModelError, match=r"PyTorch's weights(.|\n)*hilsplat models get(.|\n)*docs/models.md"):
        open_model_folder(sam)


@pytest.mark.parametrize(
    ("model_type", "words"),
    [("siglip2", "variable resolution"), ("sam3", "take SAM 2.1"), ("blip", "docs/models.md")],
)
def test_the_error_for_other_models_lists_readable_ones(sam, model_type, words):
    (sam / "config.json").write_text(json.dumps({"model_type": model_type}))
    with pytest.raises(ModelError, match=rf"SAM 2 or 2.1 \(sam2\)(.|\n)*{model_type}(.|\n)*{words}"):
        open_model_folder(sam)


def write_whole_clip(folder, external: bool) -> None:
    """A `model.onnx` whose halves scale their inputs by weights of their own."""
    wide = TensorProto.FLOAT
    values = {"vision": np.arange(64, dtype=np.float32), "text": -np.arange(64, dtype=np.float32)}
    nodes = [
        helper.make_node("Mul", ["pixel_values", "vision"], ["image_embeds"]),
        helper.make_node("Mul", ["input_ids", "text"], ["words"]),
        helper.make_node("Mul", ["words", "attention_mask"], ["text_embeds"]),
    ]
    inputs = [
        helper.make_tensor_value_info(name, wide, [1, 64])
        for name in ("pixel_values", "input_ids", "attention_mask")
    ]
    outputs = [helper.make_tensor_value_info(name, wide, [1, 64]) for name in ("image_embeds", "text_embeds")]
    initialisers = [numpy_helper.from_array(value, name) for name, value in values.items()]
    graph = helper.make_graph(nodes, "clip", inputs, outputs, initialisers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    folder.mkdir()
    options = {"save_as_external_data": True, "location": "model.onnx_data", "size_threshold": 0}
    onnx.save(model, folder / "model.onnx", **options if external else {})


@pytest.mark.parametrize("external", [False, True])
def test_halves_give_what_the_whole_gives_and_read_no_weights(tmp_path, external, monkeypatch):
    write_whole_clip(tmp_path / "clip", external)
    if external:  # above 2 GiB they could not be put into the network again
        monkeypatch.setattr(onnx, "load_external_data_for_model", pytest.fail)
    vision, text = split_clip(tmp_path / "clip")
    ones = np.ones((1, 64), np.float32)
    run = onnxruntime.InferenceSession
    np.testing.assert_array_equal(run(vision).run(None, {"pixel_values": ones})[0][0], np.arange(64))
    fed = {"input_ids": ones, "attention_mask": ones}
    np.testing.assert_array_equal(run(text).run(None, fed)[0][0], -np.arange(64))
    expected = [tmp_path / "clip/model.onnx_data"] if external else []
    assert external_weights(vision, tmp_path / "clip") == expected
