"""Model folders with the published signatures, and the results of transformers for them."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tests.published_models import exports
from tests.unit.export.conftest import clip_parts, photograph, sam_parts, transformers

__all__ = ["clip_parts", "photograph", "sam_parts", "transformers"]

Answer = Callable[..., tuple[np.ndarray, np.ndarray]]
"""Predicted IoUs and logits for features, points (P, K, 2) and whether each point is inside."""


def sam2_answer(model: nn.Module) -> Answer:
    """Return the official decoder of SAM 2 without boxes: one image, prompts along axis 1."""
    decode = exports.sam2_decoder(model)

    def answer(features, points, inside):
        embeddings = [torch.from_numpy(features[name]) for name in exports.EMBEDDINGS]
        with torch.no_grad():
            scores, masks, _ = decode(points, inside, None, *embeddings)
        return scores[0].numpy(), masks[0].numpy()

    return lambda features, points, inside: answer(
        features, torch.from_numpy(points).float()[None], torch.from_numpy(inside).long()[None]
    )


def sam_answer(model: nn.Module) -> Answer:
    """Return the official decoder of SAM."""

    def answer(features, points, inside):
        with torch.no_grad():
            found = model(
                image_embeddings=torch.from_numpy(features["image_embeddings"]),
                input_points=torch.from_numpy(points).float()[None],
                input_labels=torch.from_numpy(inside).long()[None],
                multimask_output=True,
            )
        return found.iou_scores[0].numpy(), found.pred_masks[0].numpy()

    return answer


@pytest.fixture(scope="session")
def sam2(transformers, tmp_path_factory) -> tuple[Path, Answer]:
    """SAM 2.1 with the published signature."""
    kind = exports.small_sam2()
    model = kind.model()
    exports.enliven(model)
    folder = tmp_path_factory.mktemp("published") / "sam2"
    exports.export_sam2(kind, model, folder)
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


@pytest.fixture(scope="session")
def sam2_model(sam2) -> nn.Module:
    """The model of `sam2`."""
    model = exports.small_sam2().model()
    exports.enliven(model)
    return model
