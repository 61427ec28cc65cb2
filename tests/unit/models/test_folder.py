"""A model's files, variants and preprocessing, and splitting of a whole CLIP."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from hilsplat.base.errors import ModelError
from hilsplat.models.folder import external_weights, input_side_px, open_model_folder, preprocessing_of
from hilsplat.models.layouts import NetworkSpec
from hilsplat.models.network import Network
from hilsplat.models.onnx_graph import Graph, split_clip, tensors_of
from hilsplat.segment.sam import SamModel
from tests.conftest import PROJECT
from tests.published_models.exports import link
from tests.unit.segment.handmade import move_weights, save_network

TINY = PROJECT / "models/sam-tiny"
IMAGE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


@pytest.fixture
def sam(tmp_path):
    shutil.copytree(TINY, tmp_path / "sam")
    return tmp_path / "sam"


@pytest.mark.parametrize("location", ["vision_encoder.onnx_data", "weights.bin", "onnx__MatMul_7"])
def test_the_digest_covers_external_weights_in_a_file_of_any_name(sam, location):
    assert open_model_folder(sam).digest == open_model_folder(TINY).digest  # independent of the path
    move_weights(sam / "onnx/vision_encoder.onnx", location)
    model, weights = open_model_folder(sam), sam / "onnx" / location
    assert weights in model.files
    before, network = model.digest, sam / "onnx/vision_encoder.onnx"
    source = Graph.read(network).digest  # identifies the int8 network
    weights.write_bytes(bytes(weights.stat().st_size))
    assert open_model_folder(sam).digest != before and Graph.read(network).digest != source


@pytest.mark.parametrize("location", ["../weights.bin", "/weights.bin", "weights.bin"])
def test_short_or_missing_weights_and_paths_that_lead_out_of_the_folder_are_refused(sam, location):
    path, weights = sam / "onnx/vision_encoder.onnx", sam / "onnx/weights.bin"
    move_weights(path, weights.name)
    weights.write_bytes(weights.read_bytes()[:-1])
    with pytest.raises(ModelError, match=r"its weights file weights.bin is too short(.|\n)*complete copy"):
        SamModel.load(sam)
    weights.rename(sam / "weights.bin")
    graph = onnx.load(path, load_external_data=False)
    for tensor in tensors_of(graph.graph):
        for entry in tensor.external_data:
            if entry.key == "location":
                entry.value = location
    onnx.save(graph, path)
    with pytest.raises(ModelError, match=r"its weights are missing(.|\n)*the file .*weights.bin beside it"):
        open_model_folder(sam)


def test_a_folder_of_links_as_in_the_cache_of_the_hub_works(sam, tmp_path):
    path, weights = sam / "onnx/vision_encoder.onnx", sam / "onnx/weights.bin"
    move_weights(path, weights.name)
    expected, digest = SamModel.load(sam).encode(IMAGE).features, open_model_folder(sam).digest
    model = SamModel.load(link(sam, tmp_path / "hub"))
    assert model.digest == digest
    for name, value in model.encode(IMAGE).features.items():
        np.testing.assert_array_equal(value, expected[name])


def test_external_weights_of_constants_and_of_packed_and_other_types_are_read(tmp_path):
    path, rng = tmp_path / "network.onnx", np.random.default_rng(0)
    packed = helper.make_tensor("packed", TensorProto.INT4, [4000], rng.integers(-8, 8, 4000))
    brain = helper.make_tensor("brain", TensorProto.BFLOAT16, [4000], rng.standard_normal(4000))
    plain = numpy_helper.from_array(rng.standard_normal(4000).astype(np.float32), "plain")
    constant = numpy_helper.from_array(rng.standard_normal(4000).astype(np.float32))
    nodes = [
        helper.make_node("Constant", [], ["constant"], value=constant),
        helper.make_node("Cast", ["packed"], ["a"], to=TensorProto.FLOAT),
        helper.make_node("Cast", ["brain"], ["b"], to=TensorProto.FLOAT),
        helper.make_node("Sum", ["a", "b", "plain", "constant", "x"], ["y"]),
    ]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [4000]) for name in "xy"]
    graph = helper.make_graph(nodes, "types", values[:1], values[1:], [packed, brain, plain])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)], ir_version=10), path)
    spec, x = NetworkSpec({"x": (None,)}, {"y": (None,)}), np.ones(4000, np.float32)
    expected = Network(path, spec)(x=x)[0]
    move_weights(path, "weights.bin")
    assert external_weights(path) == [tmp_path / "weights.bin"]
    np.testing.assert_array_equal(Network(path, spec)(x=x)[0], expected)


def test_a_variant_is_chosen_by_its_ending_which_all_networks_must_have(sam):
    plain, encoder = open_model_folder(sam).digest, sam / "onnx/vision_encoder.onnx"
    with pytest.raises(ModelError, match=r"have no suffix: set masks.variant to one of ''"):
        open_model_folder(sam, variant="fp16")
    shutil.copy(encoder, encoder.with_name("vision_encoder_q4.onnx"))
    for path in (encoder, sam / "onnx/prompt_encoder_mask_decoder.onnx"):
        shutil.copy(path, path.with_name(f"{path.stem}_fp16.onnx"))
    with pytest.raises(ModelError, match=r"lacks onnx/prompt_encoder_mask_decoder_q4.onnx(.|\n)*'', 'fp16'"):
        open_model_folder(sam, variant="q4")
    model = SamModel.load(sam, "fp16")
    assert model.encoder.path.name == "vision_encoder_fp16.onnx" and model.digest != plain
    encoder.unlink()
    with pytest.raises(ModelError, match=r"have suffixes: set masks.variant to one of 'fp16'"):
        SamModel.load(sam)


def test_halves_compute_the_same_as_the_whole_and_splitting_reads_no_weights(tmp_path, monkeypatch):
    text = """whole (float[1,64] pixel_values, float[1,64] input_ids, float[1,64] attention_mask)
    => (float[1,64] image_embeds, float[1,64] text_embeds) {
        image_embeds = Mul (pixel_values, more)
        words = Mul (input_ids, less)
        text_embeds = Mul (words, attention_mask)
    }"""
    numbers, folder = np.arange(64, dtype=np.float32), tmp_path / "clip"
    save_network(folder / "model.onnx", text, more=numbers, less=-numbers)
    move_weights(folder / "model.onnx", "model.onnx_data")
    monkeypatch.setattr(onnx, "load_external_data_for_model", pytest.fail)  # above 2 GiB, no graph holds them
    vision, text = split_clip(folder)
    ones = np.ones((1, 64), np.float32)
    run = onnxruntime.InferenceSession
    np.testing.assert_array_equal(run(vision).run(None, {"pixel_values": ones})[0][0], numbers)
    fed = {"input_ids": ones, "attention_mask": ones}
    np.testing.assert_array_equal(run(text).run(None, fed)[0][0], -numbers)
    assert external_weights(vision) == [folder / "model.onnx_data"]


LARGEST = r"less than or equal to 4096"
INTEGER, NUMBER = "a valid integer", "a valid number"

BAD = [
    ("size", 100_000, LARGEST),
    ("crop_size", {"height": 100_000, "width": 100_000}, LARGEST),
    ("pad_size", 0, "greater than or equal to 1"),
    ("size", True, INTEGER),
    ("crop_size", "224", INTEGER),
    ("pad_size", [], INTEGER),
    ("size", {"height": 224, "width": 336}, INTEGER),
    ("crop_size", {"shortest_edge": 224, "longest_edge": 448}, INTEGER),
    ("pad_size", {"height": [1] * 10**5}, INTEGER),
    ("image_mean", 0.5, "a valid list"),
    ("image_mean", [0.5], "at least 3 items"),
    ("image_mean", [0.5, 0.5, True], NUMBER),
    ("image_mean", [0.5, 0.5, float("nan")], "finite"),
    ("image_mean", [0.5, 0.5, 1e300], "less than or equal to 255"),
    ("image_std", [1, 1, 1e-300], "greater than or equal to 0.001"),
    ("image_std", [1, 1, float("inf")], "finite"),
    ("rescale_factor", 0, "greater than 0"),
    ("rescale_factor", 255, "less than or equal to 1"),
    ("rescale_factor", "1/255", NUMBER),
    ("resample", 99, "less than or equal to 5"),
    ("do_resize", "false", "a valid boolean"),
]


@pytest.mark.parametrize(("key", "value", "words"), BAD)
def test_values_that_cannot_be_used_are_refused(tmp_path, key, value, words):
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({key: value}))
    with pytest.raises(
        ModelError, match=rf"preprocessor_config.json: {key} is invalid\n  expected  .*{words}"
    ) as told:
        preprocessing_of(tmp_path / "preprocessor_config.json")
    assert "\n  found " in str(told.value) and len(str(told.value)) < 500


@pytest.mark.parametrize("content", ["[]", "3", '"x"', "null", "{", "[" * 10**5])
def test_files_without_settings_are_refused(tmp_path, content):
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(
        ModelError, match=r"preprocessor_config.json(: its content is invalid| cannot be read)"
    ):
        preprocessing_of(tmp_path / "preprocessor_config.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pad_size": 256}, "pad_size is smaller than size"),
        ({"do_pad": False}, "disables do_pad"),
        ({"size": {"longest_edge": 100_000}}, "size is invalid"),
    ],
)
def test_a_folder_with_unusable_values_is_not_opened(sam, change, words):
    path = sam / "preprocessor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ModelError, match=words):
        open_model_folder(sam)


@pytest.mark.parametrize(
    ("content", "side"),
    [
        # CLIP of 2021 and of today, SigLIP, SAM 2, and open_clip in two versions, as published
        ({"size": 224, "crop_size": 224, "resample": 3}, 224),
        ({"size": {"shortest_edge": 224}, "crop_size": {"height": 224, "width": 224}}, 224),
        ({"do_convert_rgb": None, "size": {"height": 512, "width": 512}}, 512),
        ({"crop_size": None, "do_pad": None, "size": {"height": 1024, "width": 1024}}, 1024),
        ({"size": [256, 256], "mean": [0.5] * 3, "std": [0.5] * 3, "mode": "RGB"}, 256),
        ({"size": 256, "interpolation": "bicubic", "resize_mode": "shortest"}, 256),
        ({}, None),
    ],
)
def test_published_forms_are_accepted(tmp_path, content, side):
    (tmp_path / "preprocessing.json").write_text(json.dumps(content))
    found = preprocessing_of(tmp_path / "preprocessing.json")
    assert found.get("crop_size", found.get("size")) == side
    assert found.get("image_mean") == content.get("mean")


def test_the_side_of_the_input_is_the_padded_one(sam):
    assert input_side_px(open_model_folder(sam)) == 384


def test_the_telemetry_of_onnxruntime_is_off(tmp_path):
    code = "import numpy, os; before = len(os.listdir('/proc/self/task'))"
    code += "; import hilsplat.models.network; print(len(os.listdir('/proc/self/task')) - before)"
    inherited = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    environment = {**inherited, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    printed = subprocess.check_output([sys.executable, "-c", code], text=True, env=environment)
    assert printed.split() == ["0"] and list(tmp_path.rglob("*")) == []
