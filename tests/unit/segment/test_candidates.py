"""What is cached of the decoder's output gives the same masks as the output itself."""

import zlib

import cv2
import numpy as np
import pytest

from hilsplat.segment.candidates import flatten_far
from hilsplat.segment.sam import Frame, quantise, restore


def smooth_logits(count: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(count, 64, 64)).astype(np.float32)
    return np.stack([12 * cv2.GaussianBlur(one, (0, 0), 3) * 3 for one in noise])


@pytest.mark.parametrize("original_hw", [(32, 24), (100, 128), (256, 256), (480, 640)])
def test_flattened_logits_give_the_same_masks(original_hw: tuple[int, int]) -> None:
    scale = 256 / max(original_hw)
    resized = (round(original_hw[0] * scale), round(original_hw[1] * scale))
    frame = Frame(original_hw, resized, (256, 256))
    for logits in quantise(smooth_logits(20, seed=sum(original_hw))):
        flat = flatten_far(logits[None])[0]
        np.testing.assert_array_equal(restore(flat, frame), restore(logits, frame))


def test_flattened_logits_pack_smaller() -> None:
    y, x = np.mgrid[:128, :128]
    ripples = np.sin(x * 7.1) * np.cos(y * 3.3)
    logits = quantise((30 - np.hypot(x - 60, y - 60) + ripples).astype(np.float32))[None]
    assert len(zlib.compress(flatten_far(logits), 1)) < len(zlib.compress(logits, 1)) / 3


def test_a_mask_without_an_edge_is_flat() -> None:
    np.testing.assert_array_equal(flatten_far(np.full((1, 8, 8), -3, np.int8)), np.full((1, 8, 8), -127))
