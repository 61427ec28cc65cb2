"""Previews of the factored decoder; its results are compared in `tests/published_models`."""

import numpy as np
import pytest

from hilsplat.segment.factored_decoder import FactoredDecoder
from hilsplat.segment.generate import decode_candidates
from hilsplat.segment.sam import SamModel, in_input, point_grid
from hilsplat.settings import MasksSettings


@pytest.fixture(params=["sam", "sam2"])
def model(request) -> SamModel:
    parts = request.getfixturevalue(f"{request.param}_parts")
    return SamModel.load(parts[-1])


def test_previews_are_every_fourth_row_and_column_and_can_be_finished(model, photograph):
    encoded, points = model.encode(photograph), point_grid(5) * (100, 60)
    in_square = in_input(points, encoded.frame)
    _, logits, _ = model.factored.decode(encoded.terms, in_square, fine=True)
    _, coarse, kept = model.factored.decode(encoded.terms, in_square, fine=False)
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


def wrong(self, layer, q, pe):
    return 1.01 * PLAIN(self, layer, q, pe)


def failing(self, layer, q, pe):
    raise ValueError("not enough values to unpack")


PLAIN = FactoredDecoder._attend_tokens


@pytest.mark.parametrize(
    ("change", "reason"), [(wrong, "the factored decoder differs by"), (failing, "not enough values")]
)
def test_a_decoder_that_differs_or_fails_runs_as_exported(sam_parts, monkeypatch, caplog, change, reason):
    monkeypatch.setattr(FactoredDecoder, "_attend_tokens", change)
    model = SamModel.load(sam_parts[-1])
    assert model.factored is None
    assert f"runs as exported, and each prompt takes about 6 times as long: {reason}" in caplog.text
