"""SAM and CLIP in torch, as on a card, give what they give on the CPU in onnxruntime and numba.

The card is simulated, and real in tests marked `gpu`. `cpu:0` is the CPU in torch; `cpu` means onnxruntime.
"""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import MemoryLimitError
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.stage import run_clip
from hilsplat.models.card import card_problem
from hilsplat.models.folder import ModelFolder, open_model_folder
from hilsplat.models.onnx_graph import split_clip
from hilsplat.models.torch_network import TorchNetwork
from hilsplat.segment.generate import decode_candidates, edge_windows
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import Frame, SamModel, in_input, point_grid, positive_boxes, read_logits
from hilsplat.segment.stage import run_masks
from hilsplat.segment.torch_decoder import TorchDecoder
from hilsplat.settings import ClipSettings, MasksSettings
from tests.conftest import PROJECT
from tests.unit.segment.handmade import pack, save_scene, smooth_logits
from tests.unit.simulated_card import simulated_card

TOLERANCE = 2e-5  # of predicted IoUs and of logits, relative to the largest logit
LOOSE = {"predicted_iou_min": 0, "stability_min": 0.1, "nms_score": 0}


@pytest.fixture(params=["simulated", pytest.param("real", marks=pytest.mark.gpu)])
def device(request, monkeypatch) -> Iterator[str]:
    if request.param == "simulated":
        with simulated_card(monkeypatch):
            yield "cuda"
    elif problem := card_problem():
        pytest.skip(problem)
    else:
        yield "cuda"


@pytest.fixture(params=["sam", "sam2", "sam-tiny"])
def folder(request) -> ModelFolder:
    if request.param == "sam-tiny":
        return open_model_folder(PROJECT / "models/sam-tiny")
    return open_model_folder(request.getfixturevalue(f"{request.param}_parts")[-1])


@pytest.mark.parametrize("kind", ["sam", "sam2"])
def test_the_factored_decoder_agrees(request, kind, photograph, device):
    model = SamModel.load(request.getfixturevalue(f"{kind}_parts")[-1])
    encoded = model.encode(photograph)
    points = in_input(point_grid(5) * (100, 60), encoded.frame)
    decoder = TorchDecoder(model.decoder, model.factored.heads, device)
    image = decoder.image(encoded.features)
    for fine in (False, True):
        expected_iou, expected, _ = model.factored.decode(encoded.terms, points, fine=fine)
        iou, logits, kept = decoder.decode(image, points, fine=fine)
        np.testing.assert_allclose(iou.cpu(), expected_iou, atol=TOLERANCE)
        np.testing.assert_allclose(logits.cpu(), expected, atol=TOLERANCE * np.abs(expected).max())
    some = {name: rows[3:20:4] for name, rows in kept.items()}
    found = decoder.logits(image, some).cpu()
    np.testing.assert_allclose(found, expected[3:20:4], atol=TOLERANCE * np.abs(expected).max())


@pytest.mark.parametrize("official", [False, True])
def test_candidates_agree(folder, photograph, device, official):
    model, on_cpu = SamModel(folder, device), SamModel(folder)
    assert isinstance(model.encoder, TorchNetwork) and (model.factored is None) == (on_cpu.factored is None)
    more = {"generator": "official", "stability": "full", "crop_layers": 1} if official else {}
    per_side = 3 if on_cpu.factored is None else 6
    settings = MasksSettings(points_per_side=per_side, **LOOSE, **more)
    expected, found = (decode_candidates(photograph, each, settings) for each in (on_cpu, model))
    assert len(expected.head) > 1
    for name, values in vars(expected).items():
        other = getattr(found, name)
        assert (other.dtype, other.shape) == (values.dtype, values.shape)
        if name not in ("logits", "predicted_iou", "stability"):
            np.testing.assert_array_equal(other, values)
    np.testing.assert_allclose(found.predicted_iou, expected.predicted_iou, atol=1e-4)
    np.testing.assert_allclose(found.stability, expected.stability, atol=3e-3)  # a few pixels on the border
    one, other = expected.logits.astype(float), found.logits.astype(float)
    in_band = (np.abs(one) < 127) & (np.abs(other) < 127)
    # these random networks return many logits of 0, which decide how far bands reach
    assert in_band.mean() > 0.1 and (in_band != (np.abs(one) < 127)).mean() < 0.02
    # steps of int8, or rounding of unrounded logits up to 40
    np.testing.assert_allclose(other[in_band], one[in_band], atol=5e-3 if official else 1)


@pytest.mark.parametrize(("exact", "offset"), [(False, 1.0), (True, 20.0)])
def test_masks_are_read_from_the_same_logits_exactly(device, exact, offset):
    frame = Frame((48, 64), (96, 128), (128, 128))
    logits = smooth_logits(20, 32, seed=1)
    logits[3] = -1  # an empty mask
    logits[4, -5:, -5:] = 30  # touches the border
    on_device = torch.from_numpy(logits).to(device)
    steps, stability, boxes = read_logits(logits, offset, frame)
    found = read_logits(on_device, offset, frame)
    np.testing.assert_array_equal(found[0].cpu(), steps)
    np.testing.assert_array_equal(found[1], stability)
    np.testing.assert_array_equal(found[2], boxes)
    assert not boxes[3].any() and (positive_boxes(on_device) == positive_boxes(logits)).all()
    rows = np.flatnonzero(boxes.any(axis=1))[::2]
    pair = (logits, on_device) if exact else (steps, found[0])
    boxes = positive_boxes(pair[0])
    for one, other in zip(*(edge_windows(each, rows, boxes) for each in pair), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(other, one)


def test_calls_that_do_not_fit_into_memory_are_made_smaller_or_name_the_setting(
    sam_parts, photograph, monkeypatch
):
    model = SamModel(open_model_folder(sam_parts[-1]), "cpu:0")
    settings = MasksSettings(points_per_side=6, **LOOSE)
    expected, decode = decode_candidates(photograph, model, settings), TorchDecoder.decode

    def limited(self, image, points, *, fine):
        if len(points) > most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 GiB.")
        return decode(self, image, points, fine=fine)

    monkeypatch.setattr(TorchDecoder, "decode", limited)
    most = 3
    found = decode_candidates(photograph, model, settings)
    np.testing.assert_array_equal(found.window_xyxy, expected.window_xyxy)
    np.testing.assert_array_equal(found.logits, expected.logits)
    most = 0
    with pytest.raises(MemoryLimitError, match=r"1.00 GiB(.|\n)*masks.device: cpu"):
        decode_candidates(photograph, model, settings)
    monkeypatch.setattr(TorchNetwork, "run", Mock(side_effect=torch.OutOfMemoryError("Tried 3.00 GiB.")))
    with pytest.raises(MemoryLimitError, match=r"3.00 GiB(.|\n)*masks.device: cpu"):
        model.encode(photograph)


def test_the_stage_masks(sam2_parts, photograph, tmp_path, monkeypatch, device):
    scene = save_scene(tmp_path / "scene", {"0.png": photograph, "1.png": photograph[::-1]})
    settings = MasksSettings(
        model=str(sam2_parts[-1]), points_per_side=6, min_area_px=4, precision="fp32", **LOOSE
    )
    run_masks(scene, tmp_path / "cpu", tmp_path / "cache", settings, threads=2)
    monkeypatch.setattr("hilsplat.segment.sam.network_device", lambda *given: device)
    run_masks(scene, tmp_path / "card", tmp_path / "cache", settings, threads=2)
    first, second = (read_index(tmp_path / name) for name in ("cpu", "card"))
    assert "device" not in first and second["device"] == device
    assert sum(entry["subpart"] + entry["whole"] for entry in first["views"].values()) > 2
    for view in first["views"]:
        pair = [HierarchicalMasks.load(tmp_path / name / f"{view}.npz") for name in ("cpu", "card")]
        np.testing.assert_array_equal(pair[0].level, pair[1].level)
        dense = [masks.dense() for masks in pair]
        union, shared = (dense[0] | dense[1]).sum(axis=(1, 2)), (dense[0] & dense[1]).sum(axis=(1, 2))
        assert (shared / union).min() > 0.99


def test_the_stage_clip(clip_parts, photograph, tmp_path, monkeypatch, device):
    folder = shutil.copytree(clip_parts[2], tmp_path / "clip")
    split_clip(folder)
    scene = save_scene(tmp_path / "scene", {"0.png": photograph})
    masks = MasksSettings(segmenter="graph")
    run_masks(scene, tmp_path / "masks", tmp_path / "cache", masks, threads=1)
    arguments = scene, tmp_path / "masks", None
    for precision, name, tolerance in (("fp32", "card", 1e-3), ("auto", "half", 1e-2)):
        settings = ClipSettings(model=str(folder), precision=precision)
        exact = settings.model_copy(update={"precision": "fp32"})  # auto: int8 on some processors
        run_clip(*arguments, tmp_path / f"cpu-{name}", tmp_path / "cache", exact, threads=1)
        with monkeypatch.context() as patch:
            patch.setattr("hilsplat.embed.clip.network_device", lambda *given: device)
            run_clip(*arguments, tmp_path / name, tmp_path / "cache", settings, threads=2)
        expected, found = (np.load(tmp_path / each / "0.png.npy") for each in (f"cpu-{name}", name))
        assert len(expected) > 5 and expected.std() > 0.1
        np.testing.assert_allclose(found, expected, atol=tolerance)
        assert read_index(tmp_path / name)["device"] == device
        assert "device" not in read_index(tmp_path / f"cpu-{name}")


def test_crops_that_do_not_fit_into_memory_are_embedded_in_smaller_calls(photograph, monkeypatch):
    folder = open_model_folder(PROJECT / "models/clip-tiny")
    model, run, sizes = ClipModel(folder, device="cpu:0"), TorchNetwork.run, list[int]()
    _ = model.vision  # its check also calls it
    masks = pack(np.random.default_rng(0).random((70, 60, 100)) > 0.5)
    expected = ClipModel(folder).embed_masks(photograph, masks)

    def limited(self, **feeds):
        (pixels,) = feeds.values()
        sizes.append(len(pixels))
        if len(pixels) > 20:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return run(self, **feeds)

    monkeypatch.setattr(TorchNetwork, "run", limited)
    np.testing.assert_allclose(model.embed_masks(photograph, masks), expected, atol=1e-3)
    assert sizes == [64, 32, 16, 16, 16, 16, 6]


@pytest.mark.parametrize(("shift", "precision"), [(0.0, "fp16"), (0.3, "fp32"), (np.inf, "fp32")])
def test_half_precision_is_used_if_the_masks_agree(
    sam_parts, photograph, tmp_path, monkeypatch, shift, precision
):
    model = SamModel(open_model_folder(sam_parts[-1]), "cpu:0")
    run = TorchNetwork.run

    def shifted(self, **feeds):
        return [out + shift * out.flip(-1) if self.half and shift else out for out in run(self, **feeds)]

    monkeypatch.setattr(TorchNetwork, "run", shifted)
    model.choose_precision("auto", [photograph], tmp_path)
    assert model.precision == precision and model.encoder.half == (precision == "fp16")


def test_the_cpu_does_not_import_torch(sam_parts):
    program = f"""
import sys, numpy as np
from pathlib import Path
from hilsplat.embed.clip import ClipModel
from hilsplat.segment.generate import decode_candidates
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings
image = np.zeros((60, 100, 3), np.uint8)
sam = SamModel.load(Path({str(sam_parts[-1])!r}), device="cpu")
decode_candidates(image, sam, MasksSettings(points_per_side=2))
ClipModel.load(Path({str(PROJECT / "models/clip-tiny")!r}), device="cpu").embed_picture(image)
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=PROJECT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
