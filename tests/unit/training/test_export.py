"""Exported networks equal the torch networks for every batch size."""

import numpy as np
import onnxruntime
import pytest
import torch
from tokenizers import Tokenizer

from hilsplat.models.layouts import DECODER, PREVIEW
from models.training.clip import CANONICAL, CROP_PX, Clip, ClipText, ClipVision, word_tokenizer
from models.training.export import export_clip, export_sam
from models.training.sam import (
    EMBEDDING,
    FRAME_PX,
    MASK_STRIDE,
    STRIDE,
    SamDecoder,
    SamEncoder,
    positional_embeddings,
)


def run_network(path, **inputs: np.ndarray) -> list[np.ndarray]:
    """All outputs of an exported network."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return session.run(None, inputs)


def decoded(folder, network, pixels, points, labels):
    """Embeddings, predicted IoUs and logits of the exported segmenter."""
    place, shared = run_network(folder / "onnx/vision_encoder.onnx", pixel_values=pixels.numpy())
    inputs = {"image_embeddings": place, "image_positional_embeddings": shared}
    inputs |= {"input_points": points.numpy(), "input_labels": labels.numpy()}
    return place, *run_network(folder / f"onnx/{network}.onnx", **inputs)  # predicted IoUs, logits


def round_to_half(module: torch.nn.Module) -> torch.nn.Module:
    """Round weights as in the file, so that only the arithmetic is compared."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(parameter.half().float())
    return module.eval()


@pytest.fixture(scope="module")
def sam(tmp_path_factory):
    torch.manual_seed(0)
    encoder, decoder = round_to_half(SamEncoder()), round_to_half(SamDecoder())
    folder = tmp_path_factory.mktemp("sam")
    export_sam(encoder, decoder, folder)
    return encoder, decoder, folder


@pytest.mark.parametrize(("batch", "prompts", "points"), [(1, 1, 1), (2, 3, 2)])
def test_exported_sam_equals_torch(sam, batch, prompts, points):
    encoder, decoder, folder = sam
    generator = torch.Generator().manual_seed(batch)
    pixels = torch.randn(batch, 3, FRAME_PX, FRAME_PX, generator=generator)
    points_xy = torch.rand(batch, prompts, points, 2, generator=generator) * FRAME_PX
    labels = torch.ones(batch, prompts, points, dtype=torch.int64)
    if points > 1:
        labels[:, 0, 1], labels[:, 1, 1] = 0, -1
    place, scores, masks = decoded(folder, DECODER, pixels, points_xy, labels)
    with torch.no_grad():
        embeddings = encoder(pixels)
        windows = torch.tensor([[0.0, 0.0, 1.0]]).repeat(batch, 1)
        places = embeddings, positional_embeddings(windows, FRAME_PX // STRIDE)
        expected_scores, expected_masks = decoder(points_xy, labels, *places)
        _, first_point = decoder(points_xy[:, :, :1], labels[:, :, :1], *places)
    assert masks.shape == (batch, prompts, 3, FRAME_PX // MASK_STRIDE, FRAME_PX // MASK_STRIDE)
    # The export folds batch normalisation into weights before it rounds them to float16.
    assert np.abs(place[:, :EMBEDDING] - embeddings.numpy()).max() < 5e-3
    assert np.abs(scores - expected_scores.numpy()).max() < 1e-3
    spread = np.abs(expected_masks.numpy()).max()
    assert np.abs(masks - expected_masks.numpy()).max() / spread < 1e-3
    if points > 1:  # the second point of prompt 1 is padding, which changes nothing
        assert torch.allclose(expected_masks[:, 1], first_point[:, 1], atol=1e-5)
        assert not torch.allclose(expected_masks[:, 0], first_point[:, 0], atol=1e-3)
    # The preview has every second row and column of the masks.
    _, seen, few = decoded(folder, PREVIEW, pixels, points_xy, labels)
    np.testing.assert_allclose(seen, scores, atol=1e-6)
    np.testing.assert_allclose(few, masks[..., ::2, ::2], atol=1e-5 * np.abs(masks).max())


@pytest.mark.parametrize("cells", [16, 23])
def test_masks_decoded_in_bands_equal_masks_decoded_by_pixel(sam, cells):
    _, decoder, _ = sam
    generator = torch.Generator().manual_seed(cells)
    embeddings = torch.randn(2, EMBEDDING, cells, cells, generator=generator)
    positional = positional_embeddings(torch.tensor([[0.0, 0.0, 1.0]] * 2), cells)
    points, labels = torch.rand(2, 3, 1, 2, generator=generator) * 60, torch.ones(2, 3, 1, dtype=torch.int64)
    prompts = points, labels, embeddings, positional
    every = torch.arange((2 * cells) ** 2).reshape(2 * cells, 2 * cells)
    every, few = (pixels.reshape(1, 1, -1).expand(2, 3, -1) for pixels in (every, every[::2, ::2]))
    with torch.no_grad():
        scores, logits = decoder(*prompts)
        _, expected = decoder.at_pixels(*prompts, every, torch.ones(every.shape))
        expected_scores, _ = decoder.at_pixels(*prompts, few, torch.full(few.shape, 4.0))
    assert (logits.flatten(3) - expected).abs().max() < 1e-5 * expected.abs().max()
    assert torch.allclose(scores, expected_scores, atol=1e-5)


def test_exported_clip_equals_torch(tmp_path):
    torch.manual_seed(1)
    tokenizer = word_tokenizer(["bear", "head of the bear", *CANONICAL])
    vision = round_to_half(ClipVision())
    text = round_to_half(ClipText(tokenizer.get_vocab_size()))
    export_clip(Clip(vision, text, tokenizer), tmp_path)
    for batch in (1, 3):
        pixels = torch.randn(batch, 3, CROP_PX, CROP_PX)
        (found,) = run_network(tmp_path / "onnx/vision_model.onnx", pixel_values=pixels.numpy())
        with torch.no_grad():
            assert np.abs(found - vision(pixels).numpy()).max() < 1e-3
        assert np.linalg.norm(found, axis=1) == pytest.approx(1.0, abs=1e-4)
    stored = Tokenizer.from_file(str(tmp_path / "tokenizer.json"))
    of_bear = []
    for phrases in (["bear"], ["bear", "the HEAD of a zebra", "object"]):
        encoded = stored.encode_batch(phrases)
        words = np.array([row.ids for row in encoded])
        mask = np.array([row.attention_mask for row in encoded])
        (found,) = run_network(tmp_path / "onnx/text_model.onnx", input_ids=words, attention_mask=mask)
        with torch.no_grad():
            expected = text(torch.from_numpy(words), torch.from_numpy(mask)).numpy()
        assert np.abs(found - expected).max() < 1e-3
        of_bear.append(expected[0])
    assert of_bear[0] == pytest.approx(of_bear[1], abs=1e-6)  # a text does not depend on its padding


def test_the_tokenizer_lowers_case_pads_and_maps_unknown_words():
    tokenizer = word_tokenizer(["bear", "head of the bear"])
    # words in order: bear 2, head 3, of 4, the 5
    assert tokenizer.encode("HEAD of the Bear").ids == [3, 4, 5, 2]
    short, long = tokenizer.encode_batch(["zebra", "the bear"])
    assert (short.ids, short.attention_mask) == ([1, 0], [1, 0])
    assert (long.ids, long.attention_mask) == ([5, 2], [1, 1])
