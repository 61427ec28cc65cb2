"""What the masks of all views say about each Gaussian while geometry is frozen.

For a view with compositing weights W (pixels x Gaussians, rows divided by their sum) and the masks
painted into one label map per level, B their indicator and n their areas:

- A = diag(1/n) B W: the mean weight of each Gaussian in each mask; A F are the mask means,
- G_l = sum over views of W' diag(valid_l) W (see `quadratic`),
- A_half: A over a random half of each mask's pixels, for the part loss,
- S = D W with the raw, overlapping masks D: how much of a Gaussian falls into a mask,
- mass: how much of a Gaussian is visible in each view.

Every loss of the language field, and the 3D semantic tree, need nothing else of the images.
"""

import hashlib
import logging
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float32, Int32, Int64

from hilsplat.base.artifacts import (
    INDEX,
    ViewCache,
    atomic_folder,
    read_index,
    sha256_of_bytes,
    sha256_of_file,
    sha256_of_json,
    write_index,
    write_npz,
)
from hilsplat.base.code_hash import code_hash
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import stage_log, track
from hilsplat.language.quadratic import Gram, QuadraticBuilder, StackedWeights
from hilsplat.scene.scene import Scene
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights
from hilsplat.splat.rasterise.device import choose_device

logger = logging.getLogger(__name__)

MIN_ALPHA = 0.5
"""Pixels that the Gaussians cover less than this are ignored: their features are extrapolated."""

MATRICES = ("A", "A_half", "S")


def normalised_weights(
    weights: sp.csr_matrix, min_alpha: float = MIN_ALPHA
) -> tuple[sp.csr_matrix, Float32[np.ndarray, " P"]]:
    """Divide the weights of each pixel by their sum, the accumulated alpha.

    Kept weights then sum to 1, so that a rendered feature is an average of features. Weights that
    the rasteriser dropped as too small are no part of the sum.

    Args:
        weights: compositing weights (pixels x Gaussians).
        min_alpha: pixels with a smaller sum become empty rows.

    Returns:
        the normalised matrix, columns sorted, and the accumulated alpha of each pixel.
    """
    weights = sp.csr_matrix(weights, copy=True)
    weights.sort_indices()
    counts = np.diff(weights.indptr)
    row = np.repeat(np.arange(weights.shape[0]), counts)
    alpha = np.bincount(row, weights.data, minlength=weights.shape[0])
    keep = alpha[row] >= min_alpha
    data = (weights.data / np.where(alpha > 0, alpha, 1.0)[row]).astype(np.float32)[keep]
    indptr = np.concatenate(([0], np.cumsum(np.where(alpha >= min_alpha, counts, 0))))
    matrix = sp.csr_matrix(
        (data, weights.indices[keep].astype(np.int32), indptr.astype(np.int32)), shape=weights.shape
    )
    return matrix, alpha.astype(np.float32)


def label_maps(masks: HierarchicalMasks) -> Int32[np.ndarray, "P 3"]:
    """Row of the painted mask at each pixel and level, -1 where there is none."""
    return np.stack([masks.label_map(level).reshape(-1) for level in LEVELS], axis=1)


def painted_indicator(labels: Int32[np.ndarray, "P 3"], num_masks: int, pixels: np.ndarray) -> sp.csr_matrix:
    """B: one row per mask, ones at the given pixels where it is painted (float64)."""
    rows, columns = [], []
    for index in range(labels.shape[1]):
        row = labels[:, index]
        chosen = np.flatnonzero((row >= 0) & pixels)
        rows.append(row[chosen])
        columns.append(chosen)
    row, column = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_matrix((np.ones(len(row)), (row, column)), shape=(num_masks, len(labels)))


def mask_means(
    indicator: sp.csr_matrix, weights: sp.csr_matrix
) -> tuple[sp.csr_matrix, Int64[np.ndarray, " M"]]:
    """diag(1/n) B W with float64 sums, and n; a mask without a pixel has an empty row."""
    pixels = np.diff(indicator.indptr).astype(np.int64)
    sums = indicator @ weights.astype(np.float64)
    scale = sp.diags(1.0 / np.maximum(pixels, 1))
    return _single(scale @ sums), pixels


def raw_indicator(masks: HierarchicalMasks, pixels: np.ndarray) -> sp.csr_matrix:
    """D: one row per raw mask, ones at the given pixels; masks may overlap."""
    columns, lengths = [], []
    for row in range(len(masks)):
        inside = np.flatnonzero(masks.dense(np.array([row]))[0].reshape(-1) & pixels)
        columns.append(inside)
        lengths.append(len(inside))
    indptr = np.concatenate(([0], np.cumsum(lengths))).astype(np.int64)
    column = np.concatenate(columns) if columns else np.zeros(0, np.int64)
    height, width = masks.size_hw
    return sp.csr_matrix((np.ones(len(column)), column, indptr), shape=(len(masks), height * width))


def random_half(view: str, pixels: int) -> np.ndarray:
    """A fair coin per pixel, fixed by the view's name."""
    seed = int.from_bytes(hashlib.sha256(view.encode()).digest()[:8], "little")
    return np.random.default_rng(seed).random(pixels) < 0.5


def view_contributions(view: str, weights: sp.csr_matrix, masks: HierarchicalMasks) -> dict[str, np.ndarray]:
    """All matrices of one view but W, as plain arrays (`A_data`, `A_indices`, `A_indptr`, ...).

    Args:
        view: its name, which fixes the random halves.
        weights: normalised weights (see `normalised_weights`).
        masks: the view's masks.
    """
    covered = np.diff(weights.indptr) > 0
    labels = label_maps(masks)
    num_masks = len(masks)
    half = covered & random_half(view, len(covered))
    A, pixels = mask_means(painted_indicator(labels, num_masks, covered), weights)
    A_half, half_pixels = mask_means(painted_indicator(labels, num_masks, half), weights)
    S = _single(raw_indicator(masks, covered) @ weights.astype(np.float64))
    arrays = {
        "pixels": pixels,
        "half_pixels": half_pixels,
        "mass": np.bincount(weights.indices, weights.data, minlength=weights.shape[1]).astype(np.float32),
    }
    for name, matrix in (("A", A), ("A_half", A_half), ("S", S)):
        arrays |= {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr")}
    return arrays


def labelled_rows(weights: sp.csr_matrix, labels: Int32[np.ndarray, "P 3"]) -> StackedWeights:
    """The rows of W that have Gaussians and a mask at some level."""
    valid = (labels >= 0) & (np.diff(weights.indptr) > 0)[:, None]
    rows = np.flatnonzero(valid.any(axis=1))
    return StackedWeights(weights[rows], valid[rows])


def run_contributions(
    scene_folder: Path,
    gaussians_ply: Path,
    masks_folder: Path,
    out: Path,
    cache: Path,
    settings: ContributionsSettings,
    threads: int,
) -> None:
    """One pass over the train views: write A, A_half, S, mass, and G or W.

    A killed run finds the finished views' matrices in the cache. W is rasterised again, which is
    cheaper than keeping it.

    Raises:
        MisalignedArtifactError: masks and images differ in size.
        ArtifactError: no train view has masks.
    """
    scene = Scene.load(scene_folder)
    views = scene.views("train")
    gaussians = load_ply(gaussians_ply)
    gaussians_sha256 = sha256_of_file(gaussians_ply)
    store = ViewCache(Path(cache) / "contributions")
    code = code_hash("hilsplat.language.contributions")
    parts: list[dict[str, np.ndarray]] = []
    builder = QuadraticBuilder(len(gaussians), settings.keep, threads)
    rows: dict[str, list[np.ndarray]] = {"view": [], "mask": [], "level": [], "area_px": []}
    read_index(masks_folder)
    with stage_log("contributions", scene.name) as counts:
        device = choose_device(settings.device)
        for number, view in enumerate(track(views, "contributions of views")):
            camera = scene.cameras[view]
            masks_path = Path(masks_folder) / f"{view}.npz"
            masks = HierarchicalMasks.load(masks_path)
            if masks.size_hw != camera.size_hw:
                raise MisalignedArtifactError(
                    f"masks of view {view} do not fit its camera",
                    expected=f"{camera.size_hw[0]} x {camera.size_hw[1]} (height x width)",
                    found=f"{masks.size_hw[0]} x {masks.size_hw[1]}",
                    fix="run the masks stage again",
                )
            raw = pixel_weights(
                gaussians, camera, min_weight=settings.min_weight, threads=threads, device=device
            )
            weights, _ = normalised_weights(raw)
            key = sha256_of_json(
                {
                    "code": code,
                    "gaussians": gaussians_sha256,
                    "masks": sha256_of_file(masks_path),
                    "camera": sha256_of_bytes(camera.cam_from_world.tobytes(), camera.K.tobytes()),
                    "view": view,
                    "min_weight": settings.min_weight,
                }
            )
            parts.append(
                store.get(
                    key,
                    lambda view=view, weights=weights, masks=masks: view_contributions(view, weights, masks),
                )
            )
            builder.add(labelled_rows(weights, label_maps(masks)))
            rows["view"].append(np.full(len(masks), number, np.int32))
            rows["mask"].append(np.arange(len(masks), dtype=np.int32))
            rows["level"].append(masks.level)
            rows["area_px"].append(masks.area_px)
        num_masks = sum(len(part) for part in rows["view"])
        if not num_masks:
            raise ArtifactError(
                f"no train view of {scene.name} has a mask",
                fix="loosen masks.predicted_iou_min or masks.stability_min, then run the masks stage again",
            )
        quadratic = builder.finish()
        with atomic_folder(out) as folder:
            for name in MATRICES:
                _save_stacked(folder / f"{name}.npz", name, parts)
            write_npz(
                folder / "mass.npz",
                mass=np.stack([part["mass"] for part in parts]),
                means=gaussians.means.detach().numpy().astype(np.float32),
            )
            write_npz(
                folder / "rows.npz",
                **{name: np.concatenate(values) for name, values in rows.items()},
                pixels=np.concatenate([part["pixels"] for part in parts]),
                half_pixels=np.concatenate([part["half_pixels"] for part in parts]),
            )
            kept = "G" if isinstance(quadratic, Gram) else "W"
            quadratic.save(folder / f"{kept}.npz")
            counts |= {
                "views": len(views),
                "masks": num_masks,
                "kept": kept,
                "nonzeros": quadratic.nonzeros,
                "nonzeros of W": builder.weights_nonzeros,
                "from_cache": store.hits,
            }
            write_index(
                folder,
                {view: {"masks": len(part)} for view, part in zip(views, rows["view"], strict=True)},
                scene=scene.name,
                num_gaussians=len(gaussians),
                gaussians_sha256=gaussians_sha256,
                masks_sha256=sha256_of_file(Path(masks_folder) / INDEX),
                num_masks=num_masks,
                quadratic=kept,
                nonzeros={
                    **{name: int(sum(len(part[f"{name}_data"]) for part in parts)) for name in MATRICES},
                    "W": builder.weights_nonzeros,
                    kept: quadratic.nonzeros,
                },
            )


def _save_stacked(path: Path, name: str, parts: list[dict[str, np.ndarray]]) -> None:
    """Write the rows of all views one below the other as one CSR matrix."""
    lengths = np.concatenate([np.diff(part[f"{name}_indptr"]) for part in parts])
    write_npz(
        path,
        data=np.concatenate([part[f"{name}_data"] for part in parts]),
        indices=np.concatenate([part[f"{name}_indices"] for part in parts]),
        indptr=np.concatenate(([0], np.cumsum(lengths, dtype=np.int64))),
    )


def _single(matrix: sp.spmatrix) -> sp.csr_matrix:
    """float32 CSR with sorted int32 columns."""
    matrix = sp.csr_matrix(matrix)
    matrix.sort_indices()
    return sp.csr_matrix(
        (matrix.data.astype(np.float32), matrix.indices.astype(np.int32), matrix.indptr.astype(np.int64)),
        shape=matrix.shape,
    )
