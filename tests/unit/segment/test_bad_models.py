"""Errors for a model folder that is incomplete, damaged or of another kind."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from hilsplat.base.errors import ModelError
from hilsplat.models.folder import open_model_folder
from hilsplat.models.network import require_one_space, require_three_heads
from hilsplat.segment.sam import SamModel
from tests.unit.segment.handmade import save_network, tensor, write_disc_sam

ENCODER = "onnx/vision_encoder.onnx"
PREPROCESSOR = "preprocessor_config.json"
LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 2548000000\n"


def replaced(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)


def halved(folder: Path) -> None:
    replaced(folder, ENCODER, (folder / ENCODER).read_bytes()[: (folder / ENCODER).stat().st_size // 2])


def changed(folder: Path, name: str, **entries: object) -> None:
    (folder / name).write_text(json.dumps(json.loads((folder / name).read_text()) | entries))


def renamed(folder: Path) -> None:
    (folder / ENCODER).rename(folder / "onnx" / "vision_encoder_quantized.onnx")


def as_torch(folder: Path) -> None:
    shutil.rmtree(folder / "onnx")
    (folder / "model.safetensors").touch()


def retyped(folder: Path, channels: int, kind: int) -> None:
    """Redeclare the encoder's input; onnxruntime trusts the declaration."""
    names = ("image_embeddings", "image_positional_embeddings")
    nodes = [
        helper.make_node("Cast", ["pixel_values"], ["as_float"], to=TensorProto.FLOAT),
        helper.make_node("GlobalAveragePool", ["as_float"], [names[0]]),
        helper.make_node("Identity", [names[0]], [names[1]]),
    ]
    outputs = [tensor(name, [1, channels, 1, 1]) for name in names]
    save_network(folder / ENCODER, nodes, [tensor("pixel_values", [1, channels, 32, 32], kind)], outputs, {})


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (halved, r"vision_encoder.onnx cannot be opened(.|\n)*fetch a complete copy"),
        (partial(replaced, name=ENCODER, content=b""), r"cannot be opened(.|\n)*a file of 0 bytes"),
        (partial(replaced, name=ENCODER, content=LFS_POINTER), r"Git LFS pointer(.|\n)*git lfs pull"),
        *(
            (partial(replaced, name="config.json", content=text), r"no readable config.json(.|\n)*model_type")
            for text in (b"", b"{")
        ),
        *(
            (partial(replaced, name="config.json", content=text), r"another kind of model(.|\n)*model_type")
            for text in (b"[]", b'{"model_type": 3}')
        ),
        (renamed, r"lacks onnx/vision_encoder.onnx(.|\n)*vision_encoder_quantized.onnx"),
        (partial(changed, name=PREPROCESSOR, do_normalize=False), "disables do_normalize"),
        *(
            (partial(changed, name=PREPROCESSOR, image_std=values), "image_std cannot be used")
            for values in ([0, 1, 1], [-1, 1, 1], "x")
        ),
        (partial(changed, name=PREPROCESSOR, image_mean=[1e999, 0, 0]), "image_mean cannot be used"),
        *(
            (
                partial(changed, name="config.json", mask_generation=own),
                r"config.json: mask_generation cannot be used",
            )
            for own in ({"stability_min": 3}, {"segmenter": "graph"}, [1])
        ),
        (
            partial(retyped, channels=3, kind=TensorProto.UINT8),
            r"unexpected or missing inputs: pixel_values(.|\n)*tensor\(uint8\)",
        ),
        (
            partial(retyped, channels=1, kind=TensorProto.FLOAT),
            r"pixel_values(.|\n)*\(any, 3, any, any\)(.|\n)*\[1, 1, 32, 32\]",
        ),
        (
            partial(write_disc_sam, points_name="point_coords"),
            r"unexpected or missing inputs: input_points, point_coords",
        ),
        (
            partial(write_disc_sam, heads=4),
            r"unexpected or missing outputs(.|\n)*expected .*\(any, any, 3\)(.|\n)*'P', 4\]",
        ),
        (as_torch, r"PyTorch weights(.|\n)*hilsplat models get(.|\n)*docs/models.md"),
        *(
            (
                partial(replaced, name="config.json", content=b'{"model_type": "%s"}' % model_type),
                rf"SAM 2 or 2.1 \(sam2\)(.|\n)*{model_type.decode()}(.|\n)*{words}",
            )
            for model_type, words in (
                (b"siglip2", "variable resolution"),
                (b"sam3", "use SAM 2.1"),
                (b"blip", "docs/models.md"),
            )
        ),
    ],
)
def test_errors_for_damaged_folders(own_sam, damage: Callable[[Path], None], words):
    damage(own_sam)
    with pytest.raises(ModelError, match=words):
        SamModel.load(own_sam)


def test_a_network_without_its_weights_file_is_named(own_sam):
    path = own_sam / "onnx" / "prompt_encoder_mask_decoder.onnx"
    onnx.save(
        onnx.load(path), path, save_as_external_data=True, location="decoder.onnx_data", size_threshold=1024
    )
    assert SamModel.load(own_sam).longest_edge == 32
    (own_sam / "onnx" / "decoder.onnx_data").unlink()
    with pytest.raises(ModelError, match=r"cannot be opened(.|\n)*\.onnx_data"):
        SamModel.load(own_sam)


def test_another_kind_of_model_is_refused(disc_sam):
    with pytest.raises(ModelError, match=r"another kind(.|\n)*model_type clip(.|\n)*'sam'"):
        open_model_folder(disc_sam, "clip")


def test_networks_may_be_beside_the_configuration(own_sam):
    for path in (own_sam / "onnx").iterdir():
        path.rename(own_sam / path.name)
    assert SamModel.load(own_sam).longest_edge == 32


def test_networks_with_undeclared_shapes_are_checked_when_they_run(tmp_path):
    with pytest.raises(ModelError, match="three masks per prompt"):
        require_three_heads(tmp_path, np.zeros((1, 1, 4)), np.zeros((1, 1, 4, 2, 2)))
    require_one_space(tmp_path, 512, None)
    with pytest.raises(ModelError, match=r"do not belong together(.|\n)*512(.|\n)*768"):
        require_one_space(tmp_path, 512, 768)
