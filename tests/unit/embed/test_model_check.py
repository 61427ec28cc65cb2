"""Measured times of models, which are kept in a cache."""

import json

import pytest

from hilsplat.embed.model_check import seconds_of


@pytest.mark.parametrize(
    "content",
    [
        "{",
        '{"clip-tiny  fp32": {}}',
        '{"clip-tiny  fp32": {"crop": 1e999}}',
        '{"clip-tiny  fp32": {"crop": -1.0}}',
    ],
)
def test_damaged_times_are_measured_again(project, tmp_path, content):
    (tmp_path / "model_seconds.json").write_text(content)
    found = seconds_of(project / "models/clip-tiny", "", "fp32", tmp_path)
    assert 0 < found["crop"] < 100
    assert json.loads((tmp_path / "model_seconds.json").read_text()) == {"clip-tiny  fp32": found}
    (tmp_path / "model_seconds.json").write_text('{"clip-tiny  fp32": {"crop": 55.0}}')
    assert seconds_of(project / "models/clip-tiny", "", "fp32", tmp_path) == {"crop": 55.0}
