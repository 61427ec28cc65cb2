"""Mask decoders with published signatures give the results of transformers, by the fast path if possible."""

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.models import repeatable
from hilsplat.segment.sam import SamModel, in_input, point_grid
from tests.published_models import exports
from tests.published_models.conftest import Answer, sam2_answer, sam_answer

EXACT = 1e-5  # tolerance of float32; logits are up to 100
SLOWER = "runs as exported, and each prompt takes about 6 times as long"


def assert_answers(model: SamModel, photograph: np.ndarray, answer: Answer, tolerance: float) -> None:
    """Compare scores and logits of a grid of points, and of clicks inside and outside an object.

    `tolerance` is relative to the mean absolute logit, for the mean difference.
    """
    encoded, grid = model.encode(photograph), point_grid(4) * (100, 60)
    clicks, inside = np.array([[30.0, 20.0], [70.0, 50.0], [10.0, 5.0]]), np.array([True, False, True])
    step = model.decoder.prompts_per_call or len(grid)
    decoded = [model.decode(encoded, grid[start : start + step]) for start in range(0, len(grid), step)]
    found = [np.concatenate(each) for each in zip(*decoded, strict=True)]
    expected = answer(encoded.features, in_input(grid, encoded.frame)[:, None], np.ones((16, 1), bool))
    together = answer(encoded.features, in_input(clicks, encoded.frame)[None], inside[None])
    assert expected[1].std() > 0.1
    for (iou, logits), (expected_iou, expected_logits) in (
        (found, expected),
        (model.decode_clicks(encoded, clicks, inside), (together[0][0], together[1][0])),
    ):
        assert np.abs(iou - expected_iou).mean() < tolerance
        assert np.abs(logits - expected_logits).mean() < tolerance * np.abs(expected_logits).mean()


def test_the_published_sam_2_decoder_is_factored(sam2, photograph, caplog):
    folder, answer = sam2
    axes = exports.declared_axes(folder / "onnx" / exports.DECODER)
    assert axes["input_points"] == ["batch_size", 1, "num_points_per_image", 2]
    assert axes["input_labels"] == ["batch_size", 1, "num_points_per_image"]
    assert (folder / "onnx" / f"{exports.DECODER}_data").is_file()
    model = SamModel.load(folder)
    assert (model.factored is not None, model.decoder.axis, model.decoder.pads) == (True, 0, True)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    assert_answers(model, photograph, answer, EXACT)


def as_int32_labels(path: Path) -> None:
    """Let a decoder accept labels of 32 bits."""
    model = onnx.load(path)
    for value in model.graph.input:
        if value.name == "input_labels":
            value.type.tensor_type.elem_type = onnx.TensorProto.INT32
    for node in model.graph.node:
        node.input[:] = ["labels" if name == "input_labels" else name for name in node.input]
    model.graph.node.insert(0, onnx.helper.make_node("Cast", ["input_labels"], ["labels"], to=7))
    onnx.save(model, path)


@pytest.mark.parametrize(
    ("change", "axis"),
    [
        (lambda model, path: exports.export_sam2_decoder(model, path), 0),
        (lambda model, path: exports.export_sam2_decoder(model, path, fixed_points=False), 1),
        (lambda model, path: as_int32_labels(path), 0),
    ],
    ids=["plain TorchScript", "free prompts", "int32 labels"],
)
def test_other_forms_are_factored(changed, sam2_parts, photograph, change, axis):
    folder, answer = changed(lambda path: change(sam2_parts[0], path))
    model = SamModel.load(folder)
    assert (model.factored is not None, model.decoder.axis) == (True, axis)
    assert_answers(model, photograph, answer, EXACT)


def test_the_decoder_of_edgetam_is_factored(changed, photograph):
    model = exports.EdgeTam()

    def export(path: Path) -> None:
        exports.export_sam2_decoder(model, path)
        exports.slim(path)
        exports.move_weights(path)

    folder, _ = changed(export)
    opened = SamModel.load(folder)
    assert opened.factored is not None
    assert_answers(opened, photograph, sam2_answer(model), EXACT)


@pytest.mark.parametrize(
    ("change", "tolerance", "reason"),
    [
        (lambda model, path: exports.as_fp16(path), 0.01, "its weights are float16"),
        (lambda model, path: exports.as_int8(path), 0.1, "it has no node mask_decoder/"),
        (lambda model, path: exports.as_q4(path), 0.6, "it has no node mask_decoder/"),
        (lambda model, path: exports.export_sam2_decoder(model, path, dynamo=True), EXACT, ""),
    ],
    ids=["float16", "int8", "4 bits", "torch's dynamo exporter"],
)
def test_reduced_precisions_and_other_exporters_run_as_exported_with_a_warning(
    changed, sam2_parts, photograph, caplog, change, tolerance, reason
):
    folder, answer = changed(lambda path: change(sam2_parts[0], path))
    model = SamModel.load(folder)
    assert model.factored is None and model.as_exported
    (warning,) = [record.message for record in caplog.records if record.name.startswith("hilsplat")]
    assert SLOWER in warning and reason in warning
    assert_answers(model, photograph, answer, tolerance)


@pytest.mark.parametrize("slim", [True, False])
def test_the_published_sam_decoder_is_factored(sam_parts, photograph, tmp_path, slim):
    model, _, exported = sam_parts
    folder = shutil.copytree(exported, tmp_path / "sam")
    if slim:
        exports.slim(folder / exports.DECODER)
    assert onnx.load(folder / exports.DECODER).opset_import[0].version == 13
    opened = SamModel.load(folder)
    assert (opened.factored is not None, opened.decoder.axis, opened.decoder.pads) == (True, 1, False)
    assert_answers(opened, photograph, sam_answer(model), EXACT)


def test_a_decoder_that_accepts_only_points_is_factored_and_refuses_points_outside(
    sam_parts, photograph, tmp_path
):
    model, _, exported = sam_parts
    folder = shutil.copytree(exported, tmp_path / "sam")
    exports.export_sam_decoder_without_labels(model, folder / exports.DECODER)
    assert "input_labels" not in exports.declared_axes(folder / exports.DECODER)
    opened = SamModel.load(folder)
    assert opened.factored is not None
    encoded, grid = opened.encode(photograph), point_grid(4) * (100, 60)
    expected = sam_answer(model)(
        encoded.features, in_input(grid, encoded.frame)[:, None], np.ones((16, 1), bool)
    )
    np.testing.assert_allclose(opened.decode(encoded, grid)[0], expected[0], atol=EXACT)
    opened.decode_clicks(encoded, grid[:2], np.array([True, True]))
    with pytest.raises(ModelError, match="accepts no points outside an object"):
        opened.decode_clicks(encoded, grid[:2], np.array([True, False]))


@pytest.mark.parametrize(
    ("operator", "words"),
    [
        ("noise = RandomNormalLike (iou_scores)\n more = Mul (noise, tenth)", "returns different results"),
        ("sums = ReduceSum <keepdims = 0> (input_boxes)\n more = Mul (sums, tenth)", "requires a box"),
    ],
)
def test_networks_that_change_or_need_a_box_are_refused(changed, operator, words):
    def change(path: Path) -> None:
        model = onnx.load(path)
        for node in model.graph.node:
            for number, name in enumerate(node.output):
                if name == "iou_scores":
                    node.output[number] = "plain_scores"
        text = f"""more (float iou_scores, float input_boxes) => (float total) {{
            tenth = Constant <value_float = 0.1> ()
            {operator}
            total = Add (iou_scores, more)
        }}"""
        for node in onnx.parser.parse_graph(text).node:
            names = {"iou_scores": "plain_scores", "total": "iou_scores"}
            for part in (node.input, node.output):
                part[:] = [names.get(each, each) for each in part]
            model.graph.node.append(node)
        onnx.save(model, path)

    with pytest.raises(ModelError, match=words):
        SamModel.load(changed(change)[0])


def test_slow_networks_are_tested_once(sam2, tmp_path, monkeypatch):
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / "cache")
    folder = shutil.copytree(sam2[0], tmp_path / "sam2")
    ran: list[Path] = []
    tested = repeatable.require_repeatable

    def counted(network, *feeds) -> None:
        ran.append(network.path)
        tested(network, *feeds)

    monkeypatch.setattr(repeatable, "require_repeatable", counted)
    SamModel.load(folder)
    assert [path.name for path in ran] == [exports.ENCODER]
    SamModel.load(folder)
    assert len(ran) == 1
    config = folder / "preprocessor_config.json"
    config.write_text(config.read_text().replace("0.485", "0.5"))  # another model
    SamModel.load(folder)
    assert len(ran) == 2
    (tmp_path / "blocked").touch()
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / "blocked")
    SamModel.load(folder)
    SamModel.load(folder)
    assert len(ran) == 4
