"""SAM 2, SigLIP and open_clip's two folders give through our code what transformers gives."""

import shutil

import numpy as np
import pytest

from hilsplat.embed.clip import ClipModel
from hilsplat.embed.model_check import check_model
from hilsplat.models.onnx_graph import split_clip
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.segment.sam import Frame, SamModel, point_grid
from hilsplat.settings import MasksSettings

TOLERANCE = 1e-4
TEXTS = ["red mug", "a Mug on red", "object"]


def test_sam_2_stretches_pictures_to_its_square(sam2_parts, photograph):
    pixels, frame = SamModel.load(sam2_parts[1]).prepare(photograph)
    assert frame == Frame((60, 100), (64, 64), (64, 64), stretched=True)
    assert pixels.shape == (1, 3, 64, 64)
    # the bottom right corner is picture, not padding
    last = (photograph[-1, -1] / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    assert np.abs(pixels[0, :, -1, -1] - last).max() < 0.5


def test_sam_2_gives_what_transformers_gives(sam2_parts, photograph):
    import torch

    reference, folder = sam2_parts
    model = SamModel.load(folder)
    points = point_grid(3) * (100, 60)
    scores, logits = model.decode(model.encode(photograph), points)
    with torch.no_grad():
        found = reference(
            pixel_values=torch.from_numpy(model.prepare(photograph)[0]),
            input_points=torch.from_numpy(points * (64 / 100, 64 / 60)).float()[None, :, None],
            input_labels=torch.ones((1, 9, 1), dtype=torch.int64),
        )
    assert found.pred_masks.std() > 0.1
    np.testing.assert_allclose(scores, found.iou_scores[0].numpy(), atol=TOLERANCE, rtol=TOLERANCE)
    np.testing.assert_allclose(logits, found.pred_masks[0].numpy(), atol=TOLERANCE, rtol=TOLERANCE)


def test_masks_of_sam_2_are_enlarged_as_by_its_processor(sam2_parts, photograph):
    import torch

    model = SamModel.load(sam2_parts[1])
    keep_all = {"predicted_iou_min": 0, "stability_min": 0, "nms_score": 0, "min_area_px": 1}
    chosen = MasksSettings(points_per_side=3, box_nms_iou=1, nms_iou=1, nms_inner=0, **keep_all)
    masks = masks_from_candidates(decode_candidates(photograph, model, chosen), (60, 100), model, chosen)
    _, logits = model.decode(model.encode(photograph), point_grid(3) * (100, 60))
    rounded = torch.from_numpy(np.rint(logits * 8).clip(-127, 127)).flatten(0, 1)[None]
    large = torch.nn.functional.interpolate(rounded, (60, 100), mode="bilinear", align_corners=False)[0] > 0
    found = masks.dense()
    assert len(found) > 5
    # the order of sums may decide on the border itself
    assert (found[:, None] != large.numpy()[None]).mean(axis=(2, 3)).min(axis=1).max() < 1e-3


@pytest.mark.parametrize("split", [False, True])
def test_siglip_gives_what_transformers_gives(siglip_parts, tmp_path, split):
    import torch

    model, images, folder = siglip_parts
    shutil.copytree(folder / ("optimum" if split else "js"), tmp_path / "siglip")
    if split:
        split_clip(tmp_path / "siglip")
    ours = ClipModel.load(tmp_path / "siglip")
    crops = np.random.default_rng(0).integers(0, 255, (5, 32, 32, 3), dtype=np.uint8)
    inputs = images(list(crops), return_tensors="pt")
    unit = torch.nn.functional.normalize
    with torch.no_grad():
        expected = unit(model.get_image_features(inputs["pixel_values"])).numpy()
        np.testing.assert_allclose(ours.embed_crops(crops), expected, atol=TOLERANCE)
        for text in TEXTS:
            ids = [{"red": 1, "mug": 2, "on": 3}.get(word, 0) for word in text.lower().split()]
            padded = torch.tensor([ids + [4] * (64 - len(ids))])  # </s> ends the text and fills it up
            expected = unit(model.get_text_features(padded)).numpy()
            np.testing.assert_allclose(ours.embed_texts([text]), expected, atol=TOLERANCE)
    assert "kind       siglip" in check_model(tmp_path / "siglip")


def test_open_clip_in_two_folders_gives_what_transformers_gives(open_clip_folder, clip_parts):
    import torch

    model, processor, _ = clip_parts
    ours = ClipModel.load(open_clip_folder)
    crops = np.random.default_rng(0).integers(0, 255, (5, 32, 32, 3), dtype=np.uint8)
    unit = torch.nn.functional.normalize
    with torch.no_grad():
        pixels = processor.image_processor(list(crops), return_tensors="pt")["pixel_values"]
        expected = unit(model.get_image_features(pixels)).numpy()
        np.testing.assert_allclose(ours.embed_crops(crops), expected, atol=TOLERANCE)
        for text in TEXTS:
            inputs = processor.tokenizer([text], return_tensors="pt")
            expected = unit(model.get_text_features(**inputs)).numpy()
            np.testing.assert_allclose(ours.embed_texts([text]), expected, atol=TOLERANCE)
    assert ours.width == 12
    names = {path.relative_to(open_clip_folder).as_posix() for path in ours.model.files}
    assert {"visual/model.onnx", "textual/model.onnx", "textual/tokenizer.json"} < names
