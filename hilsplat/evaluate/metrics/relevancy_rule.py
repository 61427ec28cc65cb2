"""From relevancy maps of three levels to one mask: the rule of LangSplat's LERF evaluation.

Source: minghanqin/LangSplat `eval/evaluate_iou_loc.py`; every departure is a setting of
`RelevancyRule` and shows in its name.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32

from hilsplat.base.levels import LEVELS, Level

MAJORITY_REACH_PX = 3
"""The majority window reaches so far up and left, and as far down and right: 7 x 7."""

ThresholdOn = Literal["normalised_pm1", "normalised_01", "raw"]
LevelRule = Literal["max", "mean_in_mask"]


@dataclass(frozen=True)
class RelevancyRule:
    """How a map becomes a mask, and which level's mask is taken. The defaults are LangSplat's code.

    Attributes:
        filter_px: side of the mean filter. LangSplat's code has 30 at an image height of 730, its
            text and the paper say 20. 0 scales 30 with the height of the map.
        mix: average the filtered map with the map itself.
        threshold: what the scores must exceed.
        threshold_on: `normalised_pm1`: min-max mapped to [-1, 1], clipped at 0, so that 0.4 means
            min-max above 0.7; `normalised_01`: min-max; `raw`: the relevancy itself.
        majority: smooth the mask with the 7 x 7 majority filter.
        level_rule: `max`: the level whose (mixed) map has the highest value; `mean_in_mask`: the
            highest mean inside its own mask (LangSplat's text on 3D-OVS).
    """

    filter_px: int = 0
    mix: bool = True
    threshold: float = 0.4
    threshold_on: ThresholdOn = "normalised_pm1"
    majority: bool = True
    level_rule: LevelRule = "max"

    @property
    def name(self) -> str:
        """`langsplat_lerf`, followed by whatever departs from it."""
        departures = []
        if self.filter_px:
            departures.append(f"filter {self.filter_px}")
        if not self.mix:
            departures.append("no mix")
        if self.threshold != 0.4:
            departures.append(f"threshold {self.threshold:g}")
        if self.threshold_on != "normalised_pm1":
            departures.append(self.threshold_on)
        if not self.majority:
            departures.append("no majority")
        if self.level_rule != "max":
            departures.append(self.level_rule)
        return "langsplat_lerf" + (f" ({', '.join(departures)})" if departures else "")


def filter_side_px(filter_px: int, height_px: int) -> int:
    """Side of the mean filter; 0 stands for 30 px at a height of 730 px, scaled, at least 1."""
    return filter_px or max(1, round(30 * height_px / 730))


def mean_filter(relevancy: Float[np.ndarray, "H W"], side_px: int) -> Float32[np.ndarray, "H W"]:
    """Mean over a square window, as OpenCV does by default.

    Borders are reflected without repeating the edge pixel, and the anchor of an even window stands
    right of its middle: for side 30, output y averages rows y - 15 .. y + 14.
    """
    import cv2

    return cv2.boxFilter(
        relevancy.astype(np.float32), cv2.CV_32F, (side_px, side_px), borderType=cv2.BORDER_DEFAULT
    )


def threshold_mask(
    relevancy: Float[np.ndarray, "H W"], threshold: float = 0.4, on: ThresholdOn = "normalised_pm1"
) -> Bool[np.ndarray, "H W"]:
    """Pixels above the threshold. A constant map gives an empty mask unless `on` is `raw`."""
    if on == "raw":
        return relevancy > threshold
    shifted = relevancy - relevancy.min()
    normalised = shifted / (shifted.max() + 1e-9)
    if on == "normalised_01":
        return normalised > threshold
    return np.clip(2 * normalised - 1, 0, 1) > threshold


def majority_smooth(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Each pixel becomes the most frequent value of its 7 x 7 window; a tie gives False.

    The window is rows max(0, i - 3) .. min(i + 4, h - 1) - 1 and columns likewise, as LangSplat's
    code slices it: the last row and column are never looked at, so the filter is not symmetric
    near the lower and right edges.
    """
    height, width = mask.shape
    summed = np.zeros((height + 1, width + 1), dtype=np.int32)
    summed[1:, 1:] = mask.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    top, bottom = _window(height)
    left, right = _window(width)
    ones = summed[bottom][:, right] - summed[top][:, right] - summed[bottom][:, left] + summed[top][:, left]
    count = (bottom - top)[:, None] * (right - left)[None, :]
    return 2 * ones > count


def _window(length: int) -> tuple[np.ndarray, np.ndarray]:
    """First and one-past-last index of each position's window along an axis."""
    positions = np.arange(length)
    start = np.maximum(0, positions - MAJORITY_REACH_PX)
    stop = np.maximum(start, np.minimum(positions + MAJORITY_REACH_PX + 1, length - 1))
    return start, stop


@dataclass(frozen=True)
class SmoothedRelevancy:
    """Relevancy of one query in one view at three levels, with its filtered forms.

    Attributes:
        filtered: mean-filtered maps; localization reads these.
        mixed: what masks are made from: the mean of map and filtered map, or the map itself.
    """

    filtered: Float32[np.ndarray, "3 H W"]
    mixed: Float32[np.ndarray, "3 H W"]

    @staticmethod
    def of(relevancy: Float[np.ndarray, "3 H W"], rule: RelevancyRule) -> "SmoothedRelevancy":
        """Filter all three levels."""
        side_px = filter_side_px(rule.filter_px, relevancy.shape[1])
        raw = relevancy.astype(np.float32)
        filtered = np.stack([mean_filter(raw[level.index], side_px) for level in LEVELS])
        return SmoothedRelevancy(filtered, 0.5 * (filtered + raw) if rule.mix else raw)


def relevancy_mask(
    smoothed: SmoothedRelevancy, level: Level | None, rule: RelevancyRule
) -> tuple[Bool[np.ndarray, "H W"], Level]:
    """The mask of a level, or of the level that the rule chooses where `level` is None."""

    def mask_of(level: Level) -> np.ndarray:
        mask = threshold_mask(smoothed.mixed[level.index], rule.threshold, rule.threshold_on)
        return majority_smooth(mask) if rule.majority else mask

    if level is not None:
        return mask_of(level), level
    if rule.level_rule == "max":
        chosen = LEVELS[int(smoothed.mixed.max(axis=(1, 2)).argmax())]
        return mask_of(chosen), chosen
    masks = [mask_of(level) for level in LEVELS]
    chosen = level_by_mean_in_mask(smoothed.mixed, np.stack(masks))
    return masks[chosen.index], chosen


def level_by_mean_in_mask(relevancy: Float[np.ndarray, "3 H W"], masks: Bool[np.ndarray, "3 H W"]) -> Level:
    """The level whose mean relevancy inside its own mask is highest; an empty mask comes last."""
    means = [
        float(relevancy[level.index][masks[level.index]].mean()) if masks[level.index].any() else -np.inf
        for level in LEVELS
    ]
    return LEVELS[int(np.argmax(means))]
