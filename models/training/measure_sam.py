"""Measure the small segmenter on single points and on the pipeline's automatic masks."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped, UInt8
from torch.nn import functional

from hilsplat.base.levels import LEVELS, Level
from hilsplat.base.lineage import sha256_of_bytes
from hilsplat.base.processes import in_processes
from hilsplat.base.progress import track
from hilsplat.segment.generate import decode_candidates, masks_from_candidates
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import SamModel
from hilsplat.settings import MasksSettings
from hilsplat_world.diagnostics.mask_truth import FIT_IOU, MIN_PX, fit_of_level
from models.training.data import LabelledViews, normalised
from models.training.sam import HEADS, MASK_STRIDE, STRIDE, SamDecoder, SamEncoder, positional_embeddings

# area classes of regions, px: inclusive minimum, exclusive maximum
SIZES = {"small": (0, 400), "medium": (400, 1600), "large": (1600, np.inf)}
PER_LEVEL = 8  # maximum number of regions scored per view and level


def mean_or_zero(values: Sequence[float] | Shaped[np.ndarray, " n"]) -> float:
    return float(np.mean(values)) if len(values) else 0.0


@torch.no_grad()
def predict_masks(
    encoder: SamEncoder, decoder: SamDecoder, image: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return scores (P, 3) and mask logits (P, 3, S/2, S/2) for single points (P, 2) of a square view."""
    encoder.eval()
    decoder.eval()
    device = next(encoder.parameters()).device
    embeddings = encoder(torch.from_numpy(normalised(image[None])).to(device))
    whole = positional_embeddings(torch.tensor([[0.0, 0.0, 1.0]]), image.shape[0] // STRIDE).to(device)
    prompts = torch.from_numpy(points.astype(np.float32))[None, :, None].to(device)
    labels = torch.ones(prompts.shape[:3], dtype=torch.int64, device=device)
    scores, logits = decoder(prompts, labels, embeddings, whole)
    return scores[0].cpu().numpy(), logits[0].cpu().numpy()


def draw_regions(
    rng: np.random.Generator, labels: np.ndarray, per_level: int
) -> list[tuple[int, int, float, float]]:
    """Draw regions, at most `per_level` per level; return head, node and a random pixel (x, y) of each."""
    drawn = []
    for head, level in enumerate(HEADS):
        at_level = labels[level.index]
        ids, areas = np.unique(at_level, return_counts=True)
        for node in rng.permutation(ids[(ids >= 0) & (areas >= MIN_PX)])[:per_level]:
            ys, xs = np.nonzero(at_level == node)
            pick = int(rng.integers(len(ys)))
            drawn.append((head, int(node), xs[pick] + 0.5, ys[pick] + 0.5))
    return drawn


def measure_sam(
    encoder: SamEncoder, decoder: SamDecoder, views: LabelledViews
) -> dict[str, dict[str, float]]:
    """Measure the masks of single-point prompts per level, with equal weight for regions of at least 100 px.

    A region is drawn first and a pixel in it second; the mask of the region's level is compared with it.

    Returns:
        For each level: mean `iou`; `best`, the same for the best of the three heads; share of prompts
        `above_75` % IoU; `correlation` of predicted and true IoU; `n`; and for each of `SIZES` the mean
        `iou_<size>` (0 if there is none) and `n_<size>`.
    """
    results: dict[Level, list[tuple[float, float, float, float]]] = {level: [] for level in LEVELS}
    for view in range(len(views)):
        drawn = draw_regions(np.random.default_rng((0, 2, view)), views.labels[view], PER_LEVEL)
        if not drawn:
            continue
        points = np.array([(x, y) for _, _, x, y in drawn])
        scores, logits = predict_masks(encoder, decoder, views.images[view], points)
        enlarged = functional.interpolate(
            torch.from_numpy(logits), scale_factor=float(MASK_STRIDE), mode="bilinear", align_corners=False
        ).numpy()
        for row, (head, node, _, _) in enumerate(drawn):
            level = HEADS[head]
            truth, guess = views.labels[view][level.index] == node, enlarged[row] > 0
            iou = (truth & guess).sum(axis=(1, 2)) / (truth | guess).sum(axis=(1, 2))
            results[level].append(
                (float(iou[head]), float(iou.max()), float(scores[row, head]), float(truth.sum()))
            )
    report = {}
    for level, rows in results.items():
        values = np.array(rows).reshape(-1, 4)
        spread = len(values) > 2 and values[:, [0, 2]].std(axis=0).min() > 0
        report[level.label] = {
            "iou": mean_or_zero(values[:, 0]),
            "best": mean_or_zero(values[:, 1]),
            "above_75": mean_or_zero(values[:, 0] > 0.75),
            "correlation": float(np.corrcoef(values[:, 0], values[:, 2])[0, 1]) if spread else 0.0,
            "n": len(values),
        }
        for size, (least, below) in SIZES.items():
            of_size = values[(values[:, 3] >= least) & (values[:, 3] < below), 0]
            report[level.label] |= {f"iou_{size}": mean_or_zero(of_size), f"n_{size}": len(of_size)}
    return report


def automatic_masks(
    cache: Path,
    folder: Path,
    images: UInt8[np.ndarray, "V S S 3"],
    workers: int,
    points_per_side: int = MasksSettings().points_per_side,
) -> list[HierarchicalMasks]:
    """Segment views with an exported segmenter as the pipeline's masks stage does, and cache the masks.

    Args:
        cache: folder that may be deleted at any time; its entries depend on the segmenter and the images.
        folder: model folder.
        workers: number of processes.
        points_per_side: size of the prompt grid; other settings have their defaults.
    """
    digest = SamModel.load(folder).digest
    settings = MasksSettings(points_per_side=points_per_side).model_dump_json()
    keys = [sha256_of_bytes(digest.encode(), settings.encode(), image.tobytes()) for image in images]
    paths = [Path(cache) / "masks" / f"{key[:24]}.npz" for key in keys]
    missing = [row for row, path in enumerate(paths) if not path.is_file()]
    items = [(Path(folder), digest, points_per_side, images[row], paths[row]) for row in missing]
    if items:
        jobs = in_processes(_segment, items, workers, chunk=4)
        for _ in track(jobs, "segmenting", total=len(missing)):
            pass
    return [HierarchicalMasks.load(path) for path in paths]


@lru_cache(maxsize=1)
def _opened(folder: Path, digest: str) -> SamModel:
    """Load the model and keep it open between calls; `digest` distinguishes models of one folder."""
    return SamModel.load(folder)


def _segment(folder: Path, digest: str, points_per_side: int, image: np.ndarray, path: Path) -> None:
    model, settings = _opened(folder, digest), MasksSettings(points_per_side=points_per_side)
    candidates = decode_candidates(image, model, settings)
    masks_from_candidates(candidates, image.shape[:2], model, settings).save(path)


def measure_everything(masks: list[HierarchicalMasks], views: LabelledViews) -> dict[str, dict[str, float]]:
    """Measure how well automatic masks cover the regions of at least 100 px at their level.

    Returns:
        For each level: `recall` at IoU 0.5 and `iou` of the best mask, averaged over regions; `masks` per
        view; `precision`, the share of masks with IoU 0.5 with some region; `n` regions.
    """
    report = {}
    for level in LEVELS:
        labels = views.labels[:, level.index]
        fits = [fit_of_level(of_view, level, labels[view]) for view, of_view in enumerate(masks)]
        best = np.concatenate([np.zeros(0), *(fit.best for fit in fits)])
        count = sum(fit.masks for fit in fits)
        report[level.label] = {
            "recall": mean_or_zero(best >= FIT_IOU),
            "iou": mean_or_zero(best),
            "masks": count / max(1, len(masks)),
            "precision": sum(fit.fitting for fit in fits) / max(1, count),
            "n": len(best),
        }
    return report
