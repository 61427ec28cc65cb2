"""Masks without a model: regions of OpenCV's graph segmentation, merged at three nested scales.

This segmenter needs no SAM weights and has no notion of objects: its levels are coarse, medium and fine
regions of uniform colour, and its scores measure the contrast with the surroundings. A region that is the
same at two scales appears at both levels.
"""

import heapq

import cv2
import numpy as np
from jaxtyping import Float, Int32, UInt8

from hilsplat.base.images import resize_to_fit
from hilsplat.base.levels import LEVELS
from hilsplat.segment.masks import HierarchicalMasks, runs_of_labels

WORK_SIDE_PX = 640
"""Longer side to which images are shrunk for segmentation; finer texture doesn't separate object parts."""
BASE_SCALE = 80.0  # scale `k` of the base segmentation (Felzenszwalb and Huttenlocher), in its colour units
CONTRAST = 6.0
"""Minimum colour difference (CIELAB) from all neighbours at which a region of exactly a level's minimum size
stays separate; for larger regions, the difference is inversely proportional to their width."""
THIN_PX = 4.0
"""A region narrower than this (at working size) is treated as a seam caused by blur along a strong edge."""
THIN_HURRY = 0.01
"""Factor applied to the cost of merging a seam: seams merge first, into the more similar side."""
LIGHTNESS = 0.6
"""Weight of lightness relative to a* and b*, because shading changes lightness within an object."""
CLEAR_EDGE = 40.0  # colour difference across a border at and above which the predicted IoU is 1


def segment_graph(
    image: UInt8[np.ndarray, "H W 3"], scales: tuple[float, float, float], min_area_px: int
) -> HierarchicalMasks:
    """Segment a photograph into regions at three nested scales.

    A fine segmentation (`cv2.ximgproc.segmentation`) is merged pair by pair, cheapest first. A merge across a
    colour difference D costs D times the width of the smaller region, `min(sqrt(A), 4 A / P)` for area A and
    perimeter P. Small or thin regions thus join their most similar neighbour, and large ones stay separate
    even if they differ less. A level of minimum size s (a share of the image side) is the state in which
    every remaining merge costs at least `CONTRAST * s * sqrt(image area)`.

    The result contains one mask per level and region of at least `min_area_px`. `predicted_iou` is the mean
    colour difference along the region's border over `CLEAR_EDGE`, clipped to 1. `stability` is the share of
    scales over which the region persists unchanged, on a logarithmic axis from the level's own scale to the
    one where all regions are merged.

    Args:
        scales: minimum sizes of wholes, parts and subparts, in non-increasing order.
    """
    height, width = image.shape[:2]
    small = resize_to_fit(image, WORK_SIDE_PX)
    lab = to_lab(small)
    base = base_regions(small, min(scales))
    merges = merge_regions(base, lab)
    parts = []
    for level, scale in zip(LEVELS, scales, strict=True):
        threshold = CONTRAST * scale * base.size**0.5
        labels, dies = cut(base, merges, threshold)
        border = border_contrast(labels, lab)
        end = max(merges[-1][0] if merges else threshold, threshold * 1.001)
        life = np.log(np.clip(dies, threshold, end) / threshold) / np.log(end / threshold)
        full = cv2.resize(labels, (width, height), interpolation=cv2.INTER_NEAREST)
        counts = np.bincount(full.reshape(-1), minlength=len(border))
        large = np.flatnonzero(counts >= min_area_px)
        clear = np.clip(border[large] / CLEAR_EDGE, 0, 1).astype(np.float32)
        scores = clear, life[large].astype(np.float32)
        runs = runs_of_labels(full, large)
        parts.append(HierarchicalMasks.from_runs(*runs, level, *scores, (height, width)))
    masks = HierarchicalMasks.concatenate(parts)
    return masks.take(masks.content_order())


Merge = tuple[float, int, int]
"""Cost of a merge (never decreasing along the list) and the two merged regions; the result is a new
region, numbered after the base regions in the order of merges."""


def to_lab(image: UInt8[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Smooth texture one or two pixels wide, and convert to CIELAB with lightness scaled by `LIGHTNESS`."""
    smooth = cv2.bilateralFilter(image, d=7, sigmaColor=20, sigmaSpace=3)
    lab = cv2.cvtColor(smooth.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    return lab * np.array([LIGHTNESS, 1, 1], dtype=np.float32)


def base_regions(image: UInt8[np.ndarray, "H W 3"], finest: float) -> Int32[np.ndarray, "H W"]:
    """Return fine regions, labelled 0..n-1, of at least a quarter of the minimum area at scale `finest`."""
    least_px = max(4, round((finest**2) * image.shape[0] * image.shape[1] / 4))
    graph = cv2.ximgproc.segmentation.createGraphSegmentation(sigma=0.5, k=BASE_SCALE, min_size=least_px)
    labels = graph.processImage(np.ascontiguousarray(image[..., ::-1]))
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)


def steps_along(axis: int, labels: Int32[np.ndarray, "H W"], lab: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the labels of each pair of adjacent pixels along an axis, and the colour difference there.

    The difference spans one more pixel on each side, because edges in photographs are wider than one pixel.
    """
    length = labels.shape[axis]
    first, second = np.arange(length - 1), np.arange(1, length)
    before, after = np.maximum(first - 1, 0), np.minimum(second + 1, length - 1)
    contrast = np.linalg.norm(lab.take(before, axis) - lab.take(after, axis), axis=2)
    return labels.take(first, axis), labels.take(second, axis), contrast


def neighbours(
    labels: Int32[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]
) -> dict[tuple[int, int], tuple[float, int]]:
    """Return the summed colour difference across the border of each pair of regions, and its length, px."""
    pairs, contrasts = [], []
    for axis in (0, 1):
        first, second, contrast = steps_along(axis, labels, lab)
        border = first != second
        pairs.append(np.sort(np.stack([first[border], second[border]], axis=1), axis=1))
        contrasts.append(contrast[border].astype(np.float64))
    unique, edge = np.unique(np.concatenate(pairs), axis=0, return_inverse=True)
    sums = np.bincount(edge.reshape(-1), weights=np.concatenate(contrasts), minlength=len(unique))
    counts = np.bincount(edge.reshape(-1), minlength=len(unique))
    borders = zip(sums.tolist(), counts.tolist(), strict=True)
    return dict(zip(map(tuple, unique.tolist()), borders, strict=True))


def roughness(labels: Int32[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, " n"]:
    """Return the texture of each region: the mean colour difference between the region's adjacent pixels."""
    total, count = np.zeros(labels.max() + 1), np.zeros(labels.max() + 1)
    for axis in (0, 1):
        first, second, contrast = steps_along(axis, labels, lab)
        inside = first == second
        total += np.bincount(first[inside], weights=contrast[inside], minlength=len(total))
        count += np.bincount(first[inside], minlength=len(total))
    return total / np.maximum(count, 1)


def merge_regions(labels: Int32[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]) -> list[Merge]:
    """Repeatedly merge the cheapest pair until one region is left; ties go to the lower numbers.

    The colour difference of a pair is the mean of two differences: between the regions' mean colours, and
    across their border (minus their mean texture, at least 0). The cost is halved if the larger region
    encloses the smaller one, and nearly zero if the smaller one is a seam (`THIN_PX`).
    """
    flat = labels.reshape(-1)
    area = np.bincount(flat).astype(np.float64).tolist()
    sums = [np.bincount(flat, weights=lab[..., axis].reshape(-1)) for axis in range(3)]
    colour = list(np.stack(sums, axis=1))
    texture = (roughness(labels, lab) * np.array(area)).tolist()
    border: list[dict[int, tuple[float, int]]] = [{} for _ in area]
    for (a, b), edge in neighbours(labels, lab).items():
        border[a][b] = border[b][a] = edge
    perimeter = [sum(edge[1] for edge in around.values()) for around in border]

    def cost(a: int, b: int) -> float:
        contrast, length = border[a][b]
        between = float(np.linalg.norm(colour[a] / area[a] - colour[b] / area[b]))
        smaller = a if area[a] < area[b] else b
        enclosed = length / max(1, perimeter[smaller])
        texture_here = (texture[a] / area[a] + texture[b] / area[b]) / 2
        across = max(0.0, contrast / length - texture_here)
        width = min(area[smaller] ** 0.5, 4 * area[smaller] / max(1, perimeter[smaller]))
        hurry = THIN_HURRY if width < THIN_PX else 1.0
        return (between + across) / 2 * (1 - enclosed / 2) * width * hurry

    queue = [(cost(a, b), a, b) for a in range(len(area)) for b in border[a] if a < b]
    heapq.heapify(queue)
    alive = [True] * len(area)
    merges: list[Merge] = []
    level = 0.0
    while queue:
        price, a, b = heapq.heappop(queue)
        if not (alive[a] and alive[b]):
            continue
        level = max(level, price)
        merges.append((level, a, b))
        new = len(area)
        alive[a] = alive[b] = False
        alive.append(True)
        area.append(area[a] + area[b])
        colour.append(colour[a] + colour[b])
        texture.append(texture[a] + texture[b])
        joined: dict[int, tuple[float, int]] = {}
        for old in (a, b):
            for other, (contrast, length) in border[old].items():
                if other not in (a, b):
                    before = joined.get(other, (0.0, 0))
                    joined[other] = (before[0] + contrast, before[1] + length)
                    del border[other][old]
        for other, edge in joined.items():
            border[other][new] = edge
        border.append(joined)
        perimeter.append(sum(edge[1] for edge in joined.values()))
        for other in joined:
            heapq.heappush(queue, (cost(other, new), other, new))
    return merges


def cut(
    labels: Int32[np.ndarray, "H W"], merges: list[Merge], threshold: float
) -> tuple[Int32[np.ndarray, "H W"], Float[np.ndarray, " n"]]:
    """Return the regions after all merges cheaper than `threshold`, as labels 0..n-1.

    The second result is the cost at which each region merges next (infinity for the last one).
    """
    num_base = int(labels.max()) + 1
    owner = np.arange(num_base + len(merges))
    dies = np.full(num_base + len(merges), np.inf)
    for step, (price, a, b) in enumerate(merges):
        dies[[a, b]] = price
        if price < threshold:
            owner[[a, b]] = num_base + step
    # an owner has a higher number than its region, so the descending order resolves all chains
    for region in range(len(owner) - 1, -1, -1):
        owner[region] = owner[owner[region]]
    roots, new = np.unique(owner[labels], return_inverse=True)
    return new.reshape(labels.shape).astype(np.int32), dies[roots]


def border_contrast(
    labels: Int32[np.ndarray, "H W"], lab: Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, " n"]:
    """Return the mean colour difference along the whole border of each region; 0 if it has no border."""
    total, length = np.zeros(labels.max() + 1), np.zeros(labels.max() + 1)
    for (a, b), (contrast, count) in neighbours(labels, lab).items():
        total[[a, b]] += contrast
        length[[a, b]] += count
    return total / np.maximum(length, 1)
