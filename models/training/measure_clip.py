"""Measure the small CLIP on masks of unseen scenes, alone and together with the segmenter's masks."""

import re
from collections.abc import Sequence

import numpy as np
import torch
from tokenizers import Tokenizer
from torch import Tensor

from hilsplat.base.levels import LEVELS
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat_world.diagnostics.mask_truth import MIN_PX
from hilsplat_world.paints import COLOURS
from models.training.clip import CANONICAL, Clip
from models.training.crops import CropTable, list_segmented
from models.training.data import LabelledViews, normalised
from models.training.measure_sam import mean_or_zero

CHUNK = 256  # crops embedded at once
COMMON = 20  # number of most common texts of each level in the smaller set of competing texts


def tokenised(tokenizer: Tokenizer, texts: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return word ids and attention mask of texts."""
    encoded = tokenizer.encode_batch(list(texts))
    return (
        torch.tensor([row.ids for row in encoded], dtype=torch.int64),
        torch.tensor([row.attention_mask for row in encoded], dtype=torch.int64),
    )


@torch.no_grad()
def embedded_crops(clip: Clip, crops: CropTable, rows: np.ndarray, background: str = "black") -> np.ndarray:
    """Return the unit vectors of some crops."""
    vision = clip.vision.eval()
    device = next(vision.parameters()).device
    parts = []
    for start in range(0, len(rows), CHUNK):
        cut = np.stack([crops.cut(int(row), background) for row in rows[start : start + CHUNK]])
        parts.append(vision(torch.from_numpy(normalised(cut)).to(device)).cpu().numpy())
    return np.concatenate(parts) if parts else np.zeros((0, 1), np.float32)


@torch.no_grad()
def embedded_texts(clip: Clip, texts: Sequence[str]) -> np.ndarray:
    """Return the unit vectors of texts."""
    encoder = clip.text.eval()
    device = next(encoder.parameters()).device
    words, mask = tokenised(clip.tokenizer, texts)
    return encoder(words.to(device), mask.to(device)).cpu().numpy()


def coloured_text(phrases: Sequence[str]) -> str | None:
    """Return the phrase that names a node by colour and class, such as "red kettle", or None."""
    pattern = re.compile(rf"({'|'.join(map(re.escape, COLOURS))}) {re.escape(phrases[0])}")
    return next((phrase for phrase in phrases if pattern.fullmatch(phrase)), None)


def measure_clip(
    clip: Clip,
    crops: CropTable,
    rows: np.ndarray | None = None,  # rows to measure; None measures all
    background: str = "black",
) -> dict[tuple[str, str], dict[str, float]]:
    """Measure how often a crop's own text is the most similar one, per kind of mask and level.

    Masks without a caption are skipped. The texts of the nodes of all masks compete.

    Returns:
        By ("exact" or "rough", level): accuracies `top1` and `top3` among all texts, `top1_of_level` among
        the level's texts, and `top1_of_common` among the 20 most common texts of each level, for crops that
        have one of them; `above_canonical`, the share of crops whose text beats every canonical phrase;
        `coloured`, top-1 among texts of colour and class, for crops that have one; and the number `n`.
    """
    rows = np.arange(len(crops)) if rows is None else rows
    rows = rows[crops.caption[rows] >= 0]
    texts = sorted({phrases[0] for phrases in crops.phrase_sets})
    of_set = np.array([texts.index(phrases[0]) for phrases in crops.phrase_sets], np.int64)
    coloured = [coloured_text(phrases) for phrases in crops.phrase_sets]
    hues = sorted({phrase for phrase in coloured if phrase})
    hue_row: dict[str | None, int] = {phrase: row for row, phrase in enumerate(hues)}
    hue_of_set = np.array([hue_row.get(phrase, -1) for phrase in coloured], np.int64)
    vectors = embedded_crops(clip, crops, rows, background)
    similarity = vectors @ embedded_texts(clip, texts).T
    canonical = (vectors @ embedded_texts(clip, CANONICAL).T).max(axis=1)
    true_text, hue = of_set[crops.caption[rows]], hue_of_set[crops.caption[rows]]
    best_hue = (vectors @ embedded_texts(clip, hues).T).argmax(axis=1) if hues else np.full(len(rows), -2)
    level, rough = crops.level[rows], crops.rough[rows]
    mine = similarity[np.arange(len(rows)), true_text]
    rank = (similarity > mine[:, None]).sum(axis=1)
    common = common_texts(true_text, np.where(rough, 0, level))
    rank_of_common = (similarity[:, common] > mine[:, None]).sum(axis=1)
    is_common = np.isin(true_text, common)
    report = {}
    for kind, is_rough in (("exact", False), ("rough", True)):
        for at in LEVELS:
            group = (level == int(at)) & (rough == is_rough)
            if not group.any():
                continue
            same = np.unique(true_text[level == int(at)])
            rank_of_level = (similarity[group][:, same] > mine[group, None]).sum(axis=1)
            has_common = group & is_common
            has_hue = group & (hue >= 0)
            report[(kind, at.label)] = {
                "top1": float((rank[group] == 0).mean()),
                "top3": float((rank[group] < 3).mean()),
                "top1_of_level": float((rank_of_level == 0).mean()),
                "top1_of_common": mean_or_zero(rank_of_common[has_common] == 0),
                "above_canonical": float((mine[group] > canonical[group]).mean()),
                "coloured": mean_or_zero((best_hue == hue)[has_hue]),
                "n": int(group.sum()),
            }
    return report


def common_texts(text: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the rows of the `COMMON` most frequent texts of each level, in ascending order.

    `text` is the row of each mask's text. Masks of level 0 are not counted.
    """
    common = []
    for at in LEVELS:
        rows, counts = np.unique(text[level == int(at)], return_counts=True)
        common.append(rows[np.argsort(-counts, kind="stable")[:COMMON]])
    return np.unique(np.concatenate(common))


def measure_queries(
    clip: Clip, views: LabelledViews, masks: Sequence[HierarchicalMasks]
) -> dict[str, dict[str, float]]:
    """Measure both models together: each text's most similar automatic mask in a view, and its regions.

    Regions smaller than `MIN_PX` are not queried.

    Returns:
        For each level: `iou`, the mean IoU of the mask most similar to the text and the union of all regions
        of the text; `instance`, the same with the region (or the union) that fits the mask best; `best`, the
        same with the best mask of the level; `n`, the number of pairs of view and text.
    """
    crops = list_segmented(views, masks)
    vectors = embedded_crops(clip, crops, np.arange(len(crops)))
    overlaps: dict[str, list[tuple[float, float, float]]] = {level.label: [] for level in LEVELS}
    for view in range(len(views)):
        nodes = views.nodes[view]
        for level in LEVELS:
            labels = views.labels[view][level.index]
            areas = np.bincount(labels.reshape(-1) + 1, minlength=len(nodes) + 1)[1:]
            by_text: dict[str, list[int]] = {}
            for node in np.flatnonzero(areas >= MIN_PX).tolist():
                if nodes[node].phrases:
                    by_text.setdefault(nodes[node].phrases[0], []).append(node)
            if not by_text:
                continue
            rows = masks[view].rows_of(level)
            if not len(rows):
                overlaps[level.label] += [(0.0, 0.0, 0.0)] * len(by_text)
                continue
            guesses = masks[view].dense(rows).reshape(len(rows), labels.size)
            in_view = np.flatnonzero(crops.view == view)
            in_view = in_view[np.searchsorted(crops.segmented[in_view], rows)]
            similarity = vectors[in_view] @ embedded_texts(clip, list(by_text)).T
            for column, ids in enumerate(by_text.values()):
                truths = labels.reshape(1, -1) == np.array(ids)[:, None]
                truths = np.concatenate([truths, truths.any(axis=0, keepdims=True)]).astype(np.float32)
                shared = guesses.astype(np.float32) @ truths.T
                union = guesses.sum(axis=1)[:, None] + truths.sum(axis=1)[None] - shared
                iou = shared / union
                pick = int(similarity[:, column].argmax())
                overlaps[level.label].append((float(iou[pick, -1]), float(iou[pick].max()), float(iou.max())))
    return {
        label: {
            "iou": mean_or_zero([row[0] for row in rows]),
            "instance": mean_or_zero([row[1] for row in rows]),
            "best": mean_or_zero([row[2] for row in rows]),
            "n": len(rows),
        }
        for label, rows in overlaps.items()
    }
