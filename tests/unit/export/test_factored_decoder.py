"""The factored decoder gives the numbers of the plain network."""

import numpy as np
import onnx
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.segment.decoder_weights import DecoderGraph
from hilsplat.segment.factored_decoder import FactoredDecoder
from hilsplat.segment.generate import decode_candidates
from hilsplat.segment.sam import SamModel, ask_network, in_input, point_grid
from hilsplat.settings import MasksSettings

TOLERANCE = 2e-5
"""Of logits up to 10, and of IoUs. The network itself differs by 1e-5 between numbers of prompts per call."""


@pytest.fixture(params=["sam", "sam2"])
def model(request) -> SamModel:
    parts = request.getfixturevalue(f"{request.param}_parts")
    return SamModel.load(parts[-1])


def test_scores_logits_and_previews_agree(model, photograph):
    encoded, points = model.encode(photograph), point_grid(5) * (100, 60)
    in_square = in_input(points, encoded.frame)
    expected_iou, expected = ask_network(model.decoder, encoded.features, in_square[:, None])
    iou, logits, _ = model.factored.decode(encoded.terms, in_square, fine=True)
    assert expected.std() > 0.1
    np.testing.assert_allclose(iou, expected_iou, atol=TOLERANCE)
    np.testing.assert_allclose(logits, expected, atol=TOLERANCE * np.abs(expected).max())
    iou, coarse, kept = model.factored.decode(encoded.terms, in_square, fine=False)
    np.testing.assert_array_equal(coarse, logits[..., ::4, ::4])
    some = {name: rows[3:20:4] for name, rows in kept.items()}
    np.testing.assert_array_equal(model.factored.logits(encoded.terms, some), logits[3:20:4])


def test_previewed_candidates_are_a_subset(model, photograph):
    settings = {"points_per_side": 6, "predicted_iou_min": 0, "stability_min": 0.1}
    some = decode_candidates(photograph, model, MasksSettings(**settings))  # previews first
    everything = decode_candidates(photograph, model, MasksSettings(**settings, box_nms_iou=1))
    known = {(head, each.tobytes()) for head, each in zip(everything.head, windows(everything), strict=True)}
    found = {(head, each.tobytes()) for head, each in zip(some.head, windows(some), strict=True)}
    assert found <= known and 0 < len(some.head) < len(everything.head)


def windows(candidates) -> list[np.ndarray]:
    return np.split(candidates.logits, candidates.offsets[1:-1])


def test_a_decoder_that_differs_runs_in_onnxruntime(sam_parts, monkeypatch, caplog):
    plain = FactoredDecoder._attend_tokens
    monkeypatch.setattr(
        FactoredDecoder, "_attend_tokens", lambda self, layer, q, pe: 1.01 * plain(self, layer, q, pe)
    )
    model = SamModel.load(sam_parts[-1])
    assert model.factored is None
    assert "runs in onnxruntime (slower): the factored decoder differs by" in caplog.text


@pytest.mark.parametrize(("change", "reason"), [("names", "has no node"), ("half", "s weights are float16")])
def test_an_unusual_graph_is_an_error_with_the_reason(sam_parts, tmp_path, change, reason):
    graph = onnx.load(str(next(sam_parts[-1].rglob("*mask_decoder.onnx"))))
    if change == "names":
        for number, node in enumerate(graph.graph.node):
            node.name = f"node_{number}"
    else:
        for each in graph.graph.initializer:
            if each.data_type == onnx.TensorProto.FLOAT:
                halved = onnx.numpy_helper.to_array(each).astype(np.float16)
                each.CopyFrom(onnx.numpy_helper.from_array(halved, each.name))
    path = tmp_path / "decoder.onnx"
    onnx.save(graph, str(path))
    with pytest.raises(ModelError, match=f"decoder.onnx cannot be factored: it ?{reason}"):
        FactoredDecoder(DecoderGraph(path))
