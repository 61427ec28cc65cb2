"""A CLIP model that computes no usable vectors is named by the stage; nothing is written."""

from pathlib import Path

import onnx
import onnx.parser
import pytest

from hilsplat.base.errors import ModelError
from hilsplat.cli.main import app
from hilsplat.embed.clip import ClipModel
from tests.unit.finished_desk import SCENE

HEAD = '<ir_version: 9, opset_import: ["": 17]> broken'
VECTORS = {
    "zero": "image_embeds = Sub (mean, mean)",
    "not a number": "zero = Sub (mean, mean) image_embeds = Div (zero, zero)",
    "infinite": "zero = Sub (mean, mean) one = Exp (zero) image_embeds = Div (one, zero)",
    "constant": "zero = Sub (mean, mean) image_embeds = Exp (zero)",
}


def break_clip(folder: Path, vectors: str, name: str = "vision_model") -> None:
    """Replace the image network by one with other vectors."""
    graph = f"""{HEAD} (float[batch, 3, 4, 4] pixel_values) => (float[batch, 3] image_embeds) {{
        mean = ReduceMean <axes = [2, 3], keepdims = 0> (pixel_values) {vectors} }}"""
    onnx.save(onnx.parser.parse_model(graph), folder / f"{name}.onnx")


@pytest.mark.parametrize("kind", VECTORS)
def test_the_stage_names_the_model(own_desk, monkeypatch, kind):
    monkeypatch.chdir(own_desk.parents[2])
    break_clip(Path("models/colours"), VECTORS[kind])
    words = ["clip", "--scene", f"{SCENE}/scene", "--masks", f"{SCENE}/default/masks", "--out", "broken"]
    words += ["--settings", '{"model": "models/colours"}', "--cache", "cache"]
    message = "the same vector for all crops" if kind == "constant" else "vectors without a direction"
    with pytest.raises(ModelError, match=rf"models/colours gives {message}(.|\n)*another export"):
        app(words, standalone_mode=False)
    assert not Path("broken").exists()


def test_a_text_without_a_vector_names_the_model(own_desk, monkeypatch):
    model = ClipModel.load(own_desk.parents[2] / "models/colours")
    nothing = 0 * model.embed_texts(["mug"])
    monkeypatch.setattr(model, "text", lambda **_: (nothing,))
    with pytest.raises(ModelError, match="vectors without a direction"):
        model._embed_text("book")
