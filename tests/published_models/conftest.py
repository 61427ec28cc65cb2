"""Model folders with the published signatures, and the results of transformers for them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.published_models import exports
from tests.unit.export.conftest import photograph, sam2_parts, sam_parts, transformers

__all__ = ["photograph", "sam2_parts", "sam_parts", "transformers"]

Answer = Callable[..., tuple[np.ndarray, np.ndarray]]
"""Predicted IoUs and logits for features, points (P, K, 2) and whether each point is inside."""


def sam2_answer(model: nn.Module) -> Answer:
    """Return the official decoder of SAM 2 without boxes: one image, prompts along axis 1."""
    decode = exports.sam2_decoder(model)
    return _answer(lambda features, points, inside: decode(points, inside, None, *features.values()))


def sam_answer(model: nn.Module) -> Answer:
    """Return the official decoder of SAM."""

    def decode(features, points, inside):
        embeddings = features["image_embeddings"]
        found = model(
            image_embeddings=embeddings, input_points=points, input_labels=inside, multimask_output=True
        )
        return found.iou_scores, found.pred_masks

    return _answer(decode)


def _answer(decode: Callable) -> Answer:
    def answer(features, points, inside):
        tensors = {name: torch.from_numpy(value) for name, value in features.items()}
        prompts = torch.from_numpy(points).float()[None], torch.from_numpy(inside).long()[None]
        with torch.no_grad():
            scores, masks = decode(tensors, *prompts)[:2]
        return scores[0].numpy(), masks[0].numpy()

    return answer


@pytest.fixture(scope="session")
def sam2(sam2_parts) -> tuple[Path, Answer]:
    """SAM 2.1 with the published signature."""
    model, folder = sam2_parts
    return folder, sam2_answer(model)


@pytest.fixture
def changed(sam2, tmp_path) -> Callable[[Callable[[Path], None]], tuple[Path, Answer]]:
    """Return a copy of `sam2` whose decoder a function has changed."""

    def change(function: Callable[[Path], None]) -> tuple[Path, Answer]:
        folder, answer = sam2
        shutil.copytree(folder, tmp_path / "sam2")
        function(tmp_path / "sam2/onnx" / exports.DECODER)
        return tmp_path / "sam2", answer

    return change
