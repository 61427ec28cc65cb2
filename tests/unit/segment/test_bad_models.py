"""Errors for a model folder that is incomplete or of another kind."""

import json

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from hilsplat.base.errors import ModelError
from hilsplat.models.folder import open_model_folder
from hilsplat.models.network import require_one_space, require_three_heads
from hilsplat.segment.sam import SamModel


def test_a_half_downloaded_network_is_named(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    network = folder / "onnx" / "vision_encoder.onnx"
    network.write_bytes(network.read_bytes()[: network.stat().st_size // 2])
    with pytest.raises(ModelError, match=r"vision_encoder.onnx cannot be opened(.|\n)*fetch a whole copy"):
        SamModel.load(folder)


def test_an_empty_network_is_named(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    (folder / "onnx" / "vision_encoder.onnx").write_bytes(b"")
    with pytest.raises(ModelError, match=r"vision_encoder.onnx cannot be opened(.|\n)*a file of 0 bytes"):
        SamModel.load(folder)


def test_a_network_without_its_weights_file_is_named(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    path = folder / "onnx" / "prompt_encoder_mask_decoder.onnx"
    onnx.save(
        onnx.load(path), path, save_as_external_data=True, location="decoder.onnx_data", size_threshold=1024
    )
    assert SamModel.load(folder).longest_edge == 32
    (folder / "onnx" / "decoder.onnx_data").unlink()
    with pytest.raises(ModelError, match=r"cannot be opened(.|\n)*\.onnx_data"):
        SamModel.load(folder)


def test_a_git_lfs_pointer_is_recognised(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    (folder / "onnx" / "vision_encoder.onnx").write_text(
        "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 2548000000\n"
    )
    with pytest.raises(ModelError, match=r"Git LFS pointer(.|\n)*git lfs pull"):
        SamModel.load(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"model_type": 3}'])
def test_a_broken_description_is_named(make_disc_sam, tmp_path, text):
    folder = make_disc_sam(tmp_path / "sam")
    (folder / "config.json").write_text(text)
    with pytest.raises(ModelError, match=r"(no readable config.json|another kind of model)(.|\n)*model_type"):
        open_model_folder(folder, "sam")


def test_preprocessing_that_is_switched_off_is_refused(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    path = folder / "preprocessor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"do_normalize": False}))
    with pytest.raises(ModelError, match="switches off do_normalize"):
        SamModel.load(folder)


def retyped(folder, shape: list, kind: int) -> None:
    """Redeclare the encoder's input; onnxruntime trusts the declaration."""
    path = folder / "onnx" / "vision_encoder.onnx"
    cast = helper.make_node("Cast", ["pixel_values"], ["as_float"], to=TensorProto.FLOAT)
    pool = helper.make_node("GlobalAveragePool", ["as_float"], ["image_embeddings"])
    same = helper.make_node("Identity", ["image_embeddings"], ["image_positional_embeddings"])
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, shape[1], 1, 1])
        for name in ("image_embeddings", "image_positional_embeddings")
    ]
    graph = helper.make_graph(
        [cast, pool, same], "g", [helper.make_tensor_value_info("pixel_values", kind, shape)], outputs
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())


def test_a_network_that_takes_bytes_is_refused(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    retyped(folder, [1, 3, 32, 32], TensorProto.UINT8)
    with pytest.raises(ModelError, match=r"other inputs than expected: pixel_values(.|\n)*tensor\(uint8\)"):
        SamModel.load(folder)


def test_a_network_for_grey_images_is_refused(make_disc_sam, tmp_path):
    folder = make_disc_sam(tmp_path / "sam")
    retyped(folder, [1, 1, 32, 32], TensorProto.FLOAT)
    with pytest.raises(ModelError, match=r"pixel_values(.|\n)*\(any, 3, any, any\)(.|\n)*\[1, 1, 32, 32\]"):
        SamModel.load(folder)


def test_a_decoder_that_hides_its_number_of_masks_is_found_out_when_it_runs(tmp_path):
    with pytest.raises(ModelError, match="three masks per prompt"):
        require_three_heads(tmp_path, np.zeros((1, 1, 4)), np.zeros((1, 1, 4, 2, 2)))


def test_halves_of_two_clips_are_refused(tmp_path):
    require_one_space(tmp_path, 512, None)
    with pytest.raises(ModelError, match=r"do not belong together(.|\n)*512(.|\n)*768"):
        require_one_space(tmp_path, 512, 768)
