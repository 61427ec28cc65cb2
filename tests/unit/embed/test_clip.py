"""CLIP folders, crops and texts, with hand-made networks whose vectors can be computed by hand."""

import json
import logging
from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import pytest

from hilsplat.base.artifacts import read_index, read_npy, write_index, write_npz
from hilsplat.base.errors import MisalignedArtifactError, ModelError, SettingsError
from hilsplat.base.lineage import sha256_of_path
from hilsplat.configuration import parse_section
from hilsplat.embed import clip, stage
from hilsplat.embed.clip import ClipModel, open_clip_of, unit
from hilsplat.embed.stage import chosen_masks, run_clip
from hilsplat.models import int8
from hilsplat.models.folder import open_model_folder
from hilsplat.models.network import Network
from hilsplat.segment.digests import digests_in, index_entry
from hilsplat.settings import ClipSettings
from tests.unit.finished_desk import write_colour_clip
from tests.unit.segment.handmade import pack, save_network, save_scene


@pytest.fixture
def colour_clip(tmp_path) -> Path:
    """A CLIP of 4-px crops: an image is its mean colour, a text the sum of its words' colours.

    mug is red, handle green, book blue.
    """
    write_colour_clip(tmp_path / "clip")
    return tmp_path / "clip"


def two_colours() -> tuple[np.ndarray, np.ndarray]:
    """An image with a red left and a green right half, and the mask of the left half."""
    image = np.zeros((8, 8, 3), dtype=np.uint8)
    image[:, :4, 0] = image[:, 4:, 1] = 255
    mask = np.zeros((8, 8), dtype=bool)
    mask[:, :4] = True
    return image, mask


def test_the_settings_determine_the_pixels_of_a_crop(colour_clip):
    model, (image, mask) = ClipModel.load(colour_clip), two_colours()
    vectors = model.embed_masks(image, pack([mask, ~mask]))
    np.testing.assert_array_equal(vectors, np.array([[1, 0, 0], [0, 1, 0]], np.float16))  # pixels inside only
    assert vectors.dtype == np.float16
    mask[0, 7] = True  # the box is the whole image, half red and half green
    kept = model.embed_masks(image, pack([mask]), ClipSettings(background="keep"))
    np.testing.assert_allclose(kept, [[0.5**0.5, 0.5**0.5, 0]], atol=1e-3)
    # LangSplat omits the last row and column of the box: a red square of 4 x 4 remains of 5 x 5 pixels
    mask[:] = False
    mask[:5, :5] = True
    image[:5, :5] = (0, 255, 0)
    image[:4, :4] = (255, 0, 0)
    assert model.embed_masks(image, pack([mask]), ClipSettings(crop="langsplat")).tolist() == [[1, 0, 0]]


def test_vectors_do_not_depend_on_the_batch(colour_clip):
    generator = np.random.default_rng(0)
    image = generator.integers(0, 255, (12, 10, 3), dtype=np.uint8)
    masks = pack(generator.random((5, 12, 10)) > 0.7)
    model = ClipModel.load(colour_clip)
    expected = model.embed_masks(image, masks)
    np.testing.assert_array_equal(model.embed_masks(image, masks, ClipSettings(batch=2)), expected)
    np.testing.assert_allclose(np.linalg.norm(expected.astype(float), axis=1), 1, atol=2e-3)
    assert model.embed_masks(image, pack(np.zeros((0, 12, 10)))).shape == (0, 3)


def test_texts_are_unit_vectors_in_order_and_inserted_into_the_template(colour_clip):
    vectors = ClipModel.load(colour_clip).embed_texts(["book", "mug handle", "mug mug handle"])
    expected = [[0, 0, 1], [0.5**0.5, 0.5**0.5, 0], [2 / 5**0.5, 1 / 5**0.5, 0]]
    np.testing.assert_allclose(vectors, expected, atol=1e-6)
    in_template = ClipModel(open_model_folder(colour_clip), "handle {}").embed_texts(["mug"])
    np.testing.assert_array_equal(in_template, vectors[1:2])


@pytest.mark.parametrize("template", ["a photo", "a {} of a {}", "{0}", "{"])
def test_a_template_contains_the_text_once(template):
    with pytest.raises(SettingsError, match=r"evaluate\.template"):
        parse_section("evaluate", json.dumps({"template": template}))


def test_long_texts_are_truncated_with_a_warning_and_empty_ones_refused(colour_clip, caplog):
    config = {"model_type": "clip", "text_config": {"max_position_embeddings": 4}}
    (colour_clip / "config.json").write_text(json.dumps(config))
    model = ClipModel.load(colour_clip)
    np.testing.assert_allclose(model.embed_texts(["mug mug mug mug handle"]), [[1, 0, 0]])
    assert "truncated after 4 tokens" in caplog.text
    with pytest.raises(ModelError, match="text '' contains no tokens"):
        model.embed_texts([""])


def test_zero_vectors_stay_zero():
    np.testing.assert_allclose(unit(np.array([[0, 0], [3, 4]], np.float32)), [[0, 0], [0.6, 0.8]], rtol=1e-6)


@pytest.fixture
def red_scene(tmp_path) -> tuple[Path, Path]:
    """A scene of two training views and its masks."""
    image, mask = two_colours()
    names, masks = ("0.png", "1.png"), pack([mask, ~mask])
    for name in names:
        masks.save(tmp_path / "masks" / f"{name}.npz")
    write_index(tmp_path / "masks", dict.fromkeys(names, index_entry(masks)), scene="set/scene")
    return save_scene(tmp_path / "scene", dict.fromkeys(names, image)), tmp_path / "masks"


def test_only_the_best_crops_of_each_node_are_embedded_and_never_twice(red_scene, colour_clip, tmp_path):
    scene, masks = red_scene
    tree = tmp_path / "semantic_tree"
    # Two views of two masks: the first masks show node 0, better in the second view; no node has the others.
    write_npz(tree / "tree.npz", crop_rank=np.array([1, -1, 0, -1], np.int32))
    write_index(tree, {view: {**entry, "masks": 2} for view, entry in read_index(masks)["views"].items()})
    cache = tmp_path / "cache"
    settings = ClipSettings(model=str(colour_clip), crops_per_node=1, precision="fp32")
    run_clip(scene, masks, tree, tmp_path / "best", cache, settings, threads=1)
    found = [read_npy(tmp_path / "best" / f"{view}.png.npy").tolist() for view in (0, 1)]
    assert found == [[[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [0, 0, 0]]]

    embed = ClipModel.embed_crops
    with patch.object(ClipModel, "embed_crops", autospec=True, side_effect=embed) as embedded:
        run_clip(scene, masks, None, tmp_path / "all", cache, settings, threads=1)
    assert [len(call.args[1]) for call in embedded.call_args_list] == [1]  # both views have the same crops
    assert read_npy(tmp_path / "all" / "0.png.npy").tolist() == [[1, 0, 0], [0, 1, 0]]
    assert read_index(tmp_path / "all")["dim"] == 3
    assert digests_in(tmp_path / "all") == digests_in(masks)
    run_clip(scene, masks, None, tmp_path / "fresh", tmp_path / "other", settings, threads=2)
    with patch.object(Network, "__call__", pytest.fail):
        run_clip(scene, masks, None, tmp_path / "again", cache, settings, threads=1)
    assert len({sha256_of_path(tmp_path / name) for name in ("all", "fresh", "again")}) == 1


def test_a_tree_without_nodes_chooses_every_mask(tmp_path):
    write_npz(tmp_path / "tree.npz", crop_rank=np.full(4, -1, np.int32))
    write_index(tmp_path, {"0.png": {"masks": 2}, "1.png": {"masks": 2}})
    assert [rows.tolist() for rows in chosen_masks(tmp_path, 5).values()] == [[0, 1], [0, 1]]


@pytest.mark.parametrize(("largest", "precision"), [(1.0, "int8"), (1e4, "fp32")])
def test_int8_is_used_only_if_it_agrees_on_crops_of_the_scene(
    red_scene, colour_clip, tmp_path, largest, precision, caplog, monkeypatch
):
    scene, masks = red_scene
    # int8 has 127 steps up to the largest weight of an output, here of a pixel that is black in every crop:
    # all others vanish if it is ten thousand times as large.
    weights = np.random.default_rng(0).uniform(0.1, 1, (48, 3)).astype(np.float32)
    weights[16:] *= -1
    weights[47] = largest
    text = """vision (float[batch,3,4,4] pixel_values) => (float[batch,3] image_embeds) {
        [flatten] flat = Flatten (pixel_values)
        [product] image_embeds = MatMul (flat, weights)
    }"""
    save_network(colour_clip / "vision_model.onnx", text, weights=weights)
    settings = ClipSettings(model=str(colour_clip))
    monkeypatch.setattr(logging.root.manager, "disable", logging.DEBUG)  # by the user
    with caplog.at_level("INFO"):
        run_clip(scene, masks, None, tmp_path / "auto", tmp_path / "cache", settings, threads=1)
        assert logging.root.manager.disable == logging.DEBUG
    assert {record.name.partition(".")[0] for record in caplog.records} == {"hilsplat"}
    assert read_index(tmp_path / "auto")["precision"] == precision
    assert f"CLIP runs in {'int8' if precision == 'int8' else 'float32'}" in caplog.text
    always = settings.model_copy(update={"precision": "fp32"})
    run_clip(scene, masks, None, tmp_path / "full", tmp_path / "cache", always, threads=1)
    assert read_index(tmp_path / "full")["precision"] == "fp32"
    same = sha256_of_path(tmp_path / "auto") == sha256_of_path(tmp_path / "full")
    assert same == (precision == "fp32")


@pytest.mark.parametrize(
    ("vectors", "problem"),
    [
        ("Identity (zero)", "vectors without a direction"),
        ("Div (zero, zero)", "vectors without a direction"),
        ("Div (one, zero)", "vectors without a direction"),
        ("Identity (one)", "the same vector for all crops"),
    ],
)
def test_a_model_that_computes_no_usable_vectors_is_named(
    red_scene, colour_clip, tmp_path, monkeypatch, vectors, problem
):
    monkeypatch.setattr(stage, "FEW_CROPS", 4)  # as many as the scene has
    graph = f"""broken (float[batch,3,4,4] pixel_values) => (float[batch,3] image_embeds) {{
        mean = ReduceMean <axes = [2, 3], keepdims = 0> (pixel_values)
        zero = Sub (mean, mean) one = Exp (zero) image_embeds = {vectors} }}"""
    save_network(colour_clip / "vision_model.onnx", graph)
    inputs = *red_scene, None, tmp_path / "broken", tmp_path / "cache"
    with pytest.raises(ModelError, match=rf"clip gives {problem}(.|\n)*another export"):
        run_clip(*inputs, ClipSettings(model=str(colour_clip)), threads=1)
    assert not (tmp_path / "broken").exists()


def test_vectors_of_texts_do_not_accumulate(colour_clip, monkeypatch):
    monkeypatch.setattr(clip, "MAX_TEXTS", 2)
    model = ClipModel.load(colour_clip)
    model.text = Mock(wraps=model.text)
    expected = model.embed_texts(["red", "green", "blue"])
    np.testing.assert_array_equal(model.embed_texts(["red", "green", "blue"]), expected)
    assert model.text.call_count == 6
    monkeypatch.setattr(clip, "MAX_TEXTS", 3)
    model.embed_texts(["red"])
    assert model.text.call_count == 6


def test_a_text_without_a_vector_names_the_model(colour_clip, monkeypatch):
    model = ClipModel.load(colour_clip)
    monkeypatch.setattr(model, "text", lambda **_: (np.zeros((1, 3), np.float32),))
    with pytest.raises(ModelError, match="vectors without a direction"):
        model.embed_texts(["book"])


def test_an_agreement_is_measured_again_by_other_code_or_for_other_inputs(tmp_path, monkeypatch):
    measure = Mock(side_effect=[{"cosine": 0.995}, {"cosine": 0.5}, {"cosine": 0.5}])

    def is_used(model: str) -> bool:
        return int8.use_reduced("int8", "auto", "CLIP", tmp_path, {"model": model}, measure)

    monkeypatch.setattr(int8, "code_digest", lambda *roots: "code")
    assert [is_used("one"), is_used("one"), is_used("two")] == [True, True, False]
    monkeypatch.setattr(int8, "code_digest", lambda *roots: "edited")
    assert not is_used("one") and measure.call_count == 3


def test_an_embedded_model_runs_in_float32_with_a_warning_if_int8_is_required(project, caplog):
    embedded = open_model_folder(project / "models/clip-tiny")
    assert not int8.reduced_precision("auto", embedded, "vision_model") and not caplog.text
    assert not int8.reduced_precision("int8", embedded, "vision_model")
    assert "clip-tiny runs in float32: int8 requires a pretrained model" in caplog.text


def test_masks_of_another_scene_are_refused(red_scene, colour_clip, tmp_path):
    scene, masks = red_scene
    write_index(masks, {"7.png": read_index(masks)["views"]["0.png"]}, scene="set/scene")
    settings = ClipSettings(model=str(colour_clip))
    with pytest.raises(MisalignedArtifactError, match=r"do not match the training views(.|\n)*7\.png"):
        run_clip(scene, masks, None, tmp_path / "out", tmp_path / "cache", settings, threads=1)


def test_queries_open_the_recorded_variant_without_its_image_network(red_scene, colour_clip, tmp_path):
    scene, masks = red_scene
    for name in ("vision_model", "text_model"):
        (colour_clip / f"{name}.onnx").rename(colour_clip / f"{name}_fp16.onnx")
    settings = ClipSettings(model=str(colour_clip), variant="fp16")
    run_clip(scene, masks, None, tmp_path / "vectors", tmp_path / "cache", settings, threads=1)
    opened, model = open_clip_of(tmp_path / "vectors"), ClipModel.load(colour_clip, "fp16")
    assert opened.text.path.name == "text_model_fp16.onnx"
    assert opened.width == model.width == len(opened.embed_texts(["mug"])[0])
    assert "vision" not in vars(opened)
    picture = np.full((6, 6, 3), 99, np.uint8)
    np.testing.assert_array_equal(opened.embed_picture(picture), model.embed_picture(picture))
