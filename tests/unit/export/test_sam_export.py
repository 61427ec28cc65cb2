"""Exports of SAM and SAM 2 give through our code what transformers gives."""

import shutil

import numpy as np
import pytest
import torch

from hilsplat.base.errors import ModelError
from hilsplat.models.onnx_graph import with_rowwise_attention
from hilsplat.segment.sam import Frame, SamModel, enlarged, point_grid
from tests.published_models.exports import ENCODER, move_weights
from tests.unit.segment.handmade import quantise

TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def ours(sam_parts) -> SamModel:
    return SamModel.load(sam_parts[2])


@pytest.fixture(scope="module")
def theirs(sam_parts, photograph):
    """Inputs and outputs of transformers' processor and model for a grid of points."""
    model, processor, _ = sam_parts
    points = point_grid(3) * (photograph.shape[1], photograph.shape[0])
    inputs = processor(photograph, input_points=[[[point] for point in points.tolist()]], return_tensors="pt")
    with torch.no_grad():
        outputs = model(
            pixel_values=inputs["pixel_values"],
            input_points=inputs["input_points"].float(),
            input_labels=torch.ones(inputs["input_points"].shape[:3], dtype=torch.long),
            multimask_output=True,
        )
    return points, inputs, outputs


def test_images_embeddings_scores_and_small_masks_agree(ours, sam_parts, theirs, photograph):
    points, inputs, outputs = theirs
    pixels, frame = ours.prepare(photograph)
    np.testing.assert_allclose(pixels, inputs["pixel_values"].numpy(), atol=TOLERANCE)
    assert frame.resized_hw == tuple(inputs["reshaped_input_sizes"][0].tolist())
    assert frame.original_hw == tuple(inputs["original_sizes"][0].tolist())
    with torch.no_grad():
        embeddings = sam_parts[0].get_image_embeddings(inputs["pixel_values"]).numpy()
        positional = sam_parts[0].get_image_wide_positional_embeddings().numpy()
    encoded = ours.encode(photograph)
    assert embeddings.std() > 0.1
    np.testing.assert_allclose(encoded.features["image_embeddings"], embeddings, atol=TOLERANCE)
    found = encoded.features["image_positional_embeddings"][0]
    np.testing.assert_allclose(found, positional.reshape(16, 8, 8), atol=TOLERANCE)
    scores, logits = ours.decode(encoded, points)
    assert outputs.pred_masks.std() > 0.1
    np.testing.assert_allclose(scores, outputs.iou_scores[0].numpy(), atol=TOLERANCE)
    np.testing.assert_allclose(logits, outputs.pred_masks[0].numpy(), atol=TOLERANCE)


def test_rowwise_global_attention_gives_the_same_result(ours, photograph):
    assert not ours.as_exported
    path = ours.model.networks["vision_encoder"]
    graph = with_rowwise_attention(path, [1], 2, 8).model.graph
    assert [node.name for node in graph.node if node.op_type == "Softmax"] == [
        "/vision_encoder/layers.0/attn/Softmax"
    ]
    pixels, _ = ours.prepare(photograph)
    plain = ours.model.network("vision_encoder")(pixel_values=pixels)
    for found, expected in zip(ours.encoder(pixel_values=pixels), plain, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)
    with pytest.raises(ModelError, match="layer 7 has no global attention"):
        with_rowwise_attention(path, [0, 7], 2, 8)


def test_external_weights_as_in_sam_vit_huge_give_the_same_result(ours, photograph, tmp_path):
    folder = shutil.copytree(ours.model.folder, tmp_path / "sam")
    move_weights(folder / ENCODER)
    model = SamModel.load(folder)
    assert not model.as_exported
    for name, found in model.encode(photograph).features.items():
        np.testing.assert_array_equal(found, ours.encode(photograph).features[name])


def test_masks_agree_at_full_size(ours, sam_parts, theirs, photograph):
    _, inputs, outputs = theirs
    rounded = quantise(outputs.pred_masks[0].numpy())
    processor = sam_parts[1].image_processor
    (full,) = processor.post_process_masks(
        [outputs.pred_masks.new_tensor(rounded.astype(np.float32))],
        inputs["original_sizes"],
        inputs["reshaped_input_sizes"],
    )
    frame = ours.prepare(photograph)[1]
    found = enlarged(rounded.reshape(-1, *rounded.shape[2:]).astype(np.float32), frame)
    expected = full.numpy().reshape(found.shape)
    assert 0.02 < expected.mean() < 0.98
    assert (found != expected).mean() < 1e-4  # rounding may decide on the border itself


def test_sam_2_stretches_images_and_gives_what_transformers_gives(sam2_parts, photograph):
    model = SamModel.load(sam2_parts[1])
    pixels, frame = model.prepare(photograph)
    assert frame == Frame((60, 100), (64, 64), (64, 64), stretched=True)
    # the bottom right corner is image, not padding
    last = (photograph[-1, -1] / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    assert np.abs(pixels[0, :, -1, -1] - last).max() < 0.5
    encoded = model.encode(photograph)
    with torch.no_grad():
        expected = sam2_parts[0].get_image_embeddings(torch.from_numpy(pixels))
    for found, features in zip(encoded.features.values(), expected, strict=True):
        np.testing.assert_allclose(found, features.numpy(), atol=TOLERANCE * float(features.abs().max()))
    _, logits = model.decode(encoded, point_grid(3) * (100, 60))
    small = quantise(logits).astype(np.float32)
    large = torch.nn.functional.interpolate(torch.from_numpy(small), (60, 100), mode="bilinear").numpy()
    masks = enlarged(small.reshape(-1, *small.shape[2:]), frame)
    # the order of sums may decide on the border itself
    assert (masks != (large > 0).reshape(masks.shape)).mean() < 1e-3
