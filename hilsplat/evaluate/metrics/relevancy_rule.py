"""Rules by which LangSplat and its successors turn relevancy maps of three levels into one mask.

Source: minghanqin/LangSplat `eval/evaluate_iou_loc.py`; every departure is a field of `RelevancyRule`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from hilsplat.base.levels import LEVELS, Level

MAJORITY_REACH_PX = 3  # distance from the centre of the majority window to its sides, px; the window is 7 x 7

ThresholdOn = Literal["normalised_pm1", "raw"]
LevelRule = Literal["max", "mean_in_mask"]
Border = Literal["langsplat", "inside"]


@dataclass(frozen=True)
class RelevancyRule:
    """How a map becomes a mask, and which level's mask is used. The defaults follow LangSplat's code.

    LangSplat's mean filter is 30 px wide at an image height of 730 px; its text and the paper state 20. Level
    rules: `max` uses the level whose (mixed) map has the highest value, `mean_in_mask` the level with the
    highest mean inside its own mask (LangSplat's text on 3D-OVS). The finest level wins ties, because
    LangSplat stacks levels from fine to coarse. At the border, `langsplat` reflects in the mean filter and
    omits the last row and column in the majority filter; `inside` skips pixels outside it (LangSplatV2).
    """

    filter_px: int = 0  # side of the mean filter; 0 scales 30 with the height of the map
    mix: bool = True  # average the filtered map with the map itself
    threshold: float = 0.4
    # `normalised_pm1`: min-max mapped to [-1, 1], clipped at 0 (0.4: min-max above 0.7); `raw`: relevancy
    threshold_on: ThresholdOn = "normalised_pm1"
    majority: bool = True  # smooth the mask with the 7 x 7 majority filter
    level_rule: LevelRule = "max"
    border: Border = "langsplat"
    levels: tuple[Level, ...] = LEVELS  # candidates (LangSplatV2 on 3D-OVS: whole and part)
    # Under `mean_in_mask`, an empty mask ranks first (LangSplatV2: torch's argmax prefers NaN) or last.
    empty_wins: bool = False


def filter_side_px(filter_px: int, height_px: int) -> int:
    """Return the side of the mean filter; 0 means 30 px per 730 px of height, and at least 1 px."""
    return filter_px or max(1, round(30 * height_px / 730))


def mean_filter(
    relevancy: Float[np.ndarray, "H W"], side_px: int, border: Border = "langsplat"
) -> Float32[np.ndarray, "H W"]:
    """Average over a square window, with OpenCV's default border or only `inside` the image.

    OpenCV reflects borders without repeating the edge pixel, and the anchor of an even window is right of its
    centre: for side 30, output y averages rows y - 15 .. y + 14.
    """
    import cv2

    values, side_hw = np.asarray(relevancy, np.float32), (side_px, side_px)
    if border == "langsplat":
        return cv2.boxFilter(values, cv2.CV_32F, side_hw, borderType=cv2.BORDER_DEFAULT)
    summed = cv2.boxFilter(values, cv2.CV_32F, side_hw, normalize=False, borderType=cv2.BORDER_CONSTANT)
    return summed / _pixels_inside(values.shape, side_px)


@lru_cache(maxsize=4)  # views of a scene mostly have one size
def _pixels_inside(shape: tuple[int, int], side_px: int) -> Float32[np.ndarray, "H W"]:
    """Return the number of pixels of each window of the mean filter that are inside the image."""
    import cv2

    ones, side_hw = np.ones(shape, np.float32), (side_px, side_px)
    return cv2.boxFilter(ones, cv2.CV_32F, side_hw, normalize=False, borderType=cv2.BORDER_CONSTANT)


def threshold_mask(
    relevancy: Float[np.ndarray, "H W"], threshold: float = 0.4, on: ThresholdOn = "normalised_pm1"
) -> Bool[np.ndarray, "H W"]:
    """Return the pixels above the threshold. A constant map gives an empty mask unless `on` is `raw`."""
    if on == "raw":
        return relevancy > threshold
    shifted = relevancy - relevancy.min()
    return np.clip(2 * (shifted / (shifted.max() + 1e-9)) - 1, 0, 1) > threshold


def majority_smooth(mask: Bool[np.ndarray, "H W"], border: Border = "langsplat") -> Bool[np.ndarray, "H W"]:
    """Set each pixel to the most frequent value of its 7 x 7 window; a tie gives False.

    `langsplat` uses rows max(0, i - 3) .. min(i + 4, h - 1) - 1 and the corresponding columns, as sliced in
    its code: the last row and column are never used, so the filter is asymmetric there.
    """
    seen, count = _majority_windows(mask.shape, border)
    return 2 * _ones_in_windows(mask.view(np.uint8) & seen) > count


@cache
def _majority_windows(
    shape: tuple[int, int], border: Border
) -> tuple[UInt8[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]:
    """Return which pixels are used, and their number in each window."""
    seen = np.ones(shape, np.uint8)
    if border == "langsplat":
        seen[-1, :] = seen[:, -1] = 0
    return seen, _ones_in_windows(seen)


def _ones_in_windows(ones: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """Count the ones among the at most 49 pixels of each majority window."""
    import cv2

    side_hw = (2 * MAJORITY_REACH_PX + 1,) * 2
    return cv2.boxFilter(ones, cv2.CV_8U, side_hw, normalize=False, borderType=cv2.BORDER_CONSTANT)


@dataclass(frozen=True)
class SmoothedRelevancy:
    """Relevancy of one query in one view at three levels: filtered for localization, mixed for masks."""

    filtered: Float32[np.ndarray, "3 H W"]
    mixed: Float32[np.ndarray, "3 H W"]

    @staticmethod
    def of(relevancy: Float[np.ndarray, "3 H W"], rule: RelevancyRule) -> "SmoothedRelevancy":
        side_px = filter_side_px(rule.filter_px, relevancy.shape[1])
        raw = np.asarray(relevancy, np.float32)
        filtered = np.stack([mean_filter(of_level, side_px, rule.border) for of_level in raw])
        return SmoothedRelevancy(filtered, np.float32(0.5) * (filtered + raw) if rule.mix else raw)


Smooth = Callable[[RelevancyRule], SmoothedRelevancy]


def smoothing_of(relevancy: Float[np.ndarray, "3 H W"]) -> Smooth:
    """Return a function that smooths a query's relevancy once for all rules with the same filter."""

    @cache
    def by_filter(filter_px: int, mix: bool, border: Border) -> SmoothedRelevancy:
        return SmoothedRelevancy.of(relevancy, RelevancyRule(filter_px, mix, border=border))

    return lambda rule: by_filter(rule.filter_px, rule.mix, rule.border)


def relevancy_answer(
    smoothed: SmoothedRelevancy,
    level: Level | None,
    rule: RelevancyRule,
    united: Float[np.ndarray, "3 H W"] | None = None,
) -> tuple[Level, Bool[np.ndarray, "H W"]]:
    """Return a level and its mask; if `level` is None, the rule chooses the level, and finer wins ties.

    `united` is the unfiltered relevancy of a second text, whose mask is merged with the first text's mask
    before the majority filter; the level is chosen by the first text alone.
    """

    def mask_of(level: Level) -> np.ndarray:
        mask = threshold_mask(smoothed.mixed[level.index], rule.threshold, rule.threshold_on)
        if united is not None:
            mask = mask | threshold_mask(united[level.index], rule.threshold, rule.threshold_on)
        return majority_smooth(mask, rule.border) if rule.majority else mask

    if level is None and rule.level_rule == "max":
        level = max(rule.levels, key=lambda choice: (smoothed.mixed[choice.index].max(), choice))
    if level is not None:
        return level, mask_of(level)
    masks = {choice: mask_of(choice) for choice in rule.levels}

    def mean_in_mask(level: Level) -> float:
        if not masks[level].any():
            return np.inf if rule.empty_wins else -np.inf
        return float(smoothed.mixed[level.index][masks[level]].mean())

    level = max(rule.levels, key=lambda choice: (mean_in_mask(choice), choice))
    return level, masks[level]


def relevancy_mask(
    smoothed: SmoothedRelevancy,
    level: Level | None,
    rule: RelevancyRule,
    united: Float[np.ndarray, "3 H W"] | None = None,
) -> Bool[np.ndarray, "H W"]:
    """Return the mask of `relevancy_answer`."""
    return relevancy_answer(smoothed, level, rule, united)[1]
