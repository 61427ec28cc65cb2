"""Reading masks from logits on a card; `sam` and `generate` have the same functions for arrays."""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Int32, Int64
from torch import Tensor


@torch.inference_mode()
def steps_and_areas(
    logits: Tensor, step: float, thresholds: tuple[int, int], size_hw: tuple[int, int]
) -> tuple[Tensor, Int64[np.ndarray, "2 K"]]:
    """Return logits (K, h, w) as int8 steps, and the areas above each threshold in the top left `size_hw`."""
    steps = (logits / step).round().clamp(-127, 127).to(torch.int8)
    visible = steps[:, : size_hw[0], : size_hw[1]]
    limits = np.clip(thresholds, -128, 127).tolist()  # torch converts other numbers to int8 modulo 256
    areas = torch.stack([(visible > limit).sum(dim=(1, 2)) for limit in limits])
    return steps, np.asarray(areas.cpu())


@torch.inference_mode()
def positive_boxes(logits: Tensor) -> Int32[np.ndarray, "K 4"]:
    """Return the box (xyxy, end exclusive) of the positive logits (K, h, w) of each mask, else all 0."""
    inside, sides = logits > 0, []
    for axis in (1, 2):  # columns, then rows
        hit = inside.any(dim=axis).to(torch.int8)
        first, last = hit.argmax(dim=1), hit.shape[1] - hit.flip(1).argmax(dim=1)
        sides.append(torch.stack([first, last]) * hit.any(dim=1))
    (x0, x1), (y0, y1) = sides
    return np.asarray(torch.stack([x0, y0, x1, y1], dim=1).int().cpu())


@torch.inference_mode()
def windows(
    logits: Tensor, rows: Int64[np.ndarray, " m"], boxes: Int32[np.ndarray, "m 4"], reach: int
) -> np.ndarray:
    """Return the logits (K, h, w) of some masks in boxes, row by row, as `generate.edge_windows` does."""
    chosen = logits[torch.from_numpy(rows).to(logits.device)]
    if not len(rows):
        return np.asarray(chosen.cpu()).reshape(-1)
    inside = (chosen > 0).to(torch.float16 if logits.is_cuda else torch.float32)
    near = _largest(inside, reach) > 0
    whole = _largest(1 - inside, reach) == 0
    chosen = chosen.masked_fill(~near, -127).masked_fill(whole, 127)
    x0, y0, x1, y1 = torch.from_numpy(boxes).to(logits.device).T[..., None, None]
    y, x = (torch.arange(side, device=logits.device) for side in chosen.shape[1:])
    within = (y[:, None] >= y0) & (y[:, None] < y1) & (x >= x0) & (x < x1)
    return np.asarray(chosen[within].cpu())


def _largest(values: Tensor, reach: int) -> Tensor:
    """Return the largest value within a distance of `reach` along both axes."""
    values = F.max_pool2d(values, (2 * reach + 1, 1), 1, (reach, 0))
    return F.max_pool2d(values, (1, 2 * reach + 1), 1, (0, reach))
