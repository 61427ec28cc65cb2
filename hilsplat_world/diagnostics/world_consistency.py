"""View consistency of masks and answers on a synthetic scene, measured with the exact geometry."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import ArtifactError
from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.lineage import require_size
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.evaluate.metrics.masks import iou, iou_matrix
from hilsplat.evaluate.metrics.relevancy_rule import SmoothedRelevancy, relevancy_mask
from hilsplat.evaluate.protocols.answers import PackedMasks, Selections
from hilsplat.evaluate.protocols.cards import VIEW_CONSISTENCY
from hilsplat.evaluate.protocols.view_truth import Query, ViewTruth
from hilsplat.evaluate.protocols.views import given_key, label_of, rule_of
from hilsplat.evaluate.scores import Measured
from hilsplat.scene.cameras import Camera, Cameras
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.origin import masks_label
from hilsplat.settings import EvaluateSettings
from hilsplat_world.truth import load_surface, true_depth

TRUTH = "true regions"
"""Row of the labels: an upper limit for any masks, below 1 as label borders are off by up to a pixel."""

COLUMNS = (
    *("scene", "masks", "level", "view_pairs", "masks_compared"),
    *("best_iou", "disagreement", "joined_disagreement"),
)

DEPTH_TOLERANCE = 0.01
"""Maximum relative difference in depth at which two views are taken to show the same surface point."""

MIN_POINTS = 16  # masks with fewer shared points are not compared
MAX_POINTS = 50_000  # maximum number of shared points per pair of views; more are evenly subsampled
TEXTS_PER_LEVEL = 4  # number of texts per level and view; each is queried in two views


class Agreement(NamedTuple):
    """Agreement between the masks of one level in two views A and B, or the mean over pairs of views."""

    masks: int  # number of masks of A compared, over all pairs
    # mean over the masks of A of their highest IoU with any mask of B, in shared points; nan if A has no mask
    best_iou: float
    # share of all pairs of shared points that are in the same mask in one view only (1 minus the Rand index)
    disagreement: float
    # the same share among pairs that share a mask in at least one view (a Jaccard distance); nan if none
    joined_disagreement: float


def shared_points(
    camera_a: Camera,
    depth_a: Float[np.ndarray, "Ha Wa"],
    camera_b: Camera,
    depth_b: Float[np.ndarray, "Hb Wb"],
    tolerance: float = DEPTH_TOLERANCE,
    max_points: int = MAX_POINTS,
) -> tuple[Int64[np.ndarray, " P"], Int64[np.ndarray, " P"]]:
    """Return row-major pixels of A (each at most once) and of B that show the same surface points.

    At most `max_points` of A's pixel centres are used, evenly spaced.

    A point is lifted by A's depth and projected into B. It is visible in B if its depth there equals B's
    depth at the projection up to `tolerance`. Between pixel centres, B's inverse depth is interpolated, which
    is exact on planes of any slant. Next to a depth jump the interpolated value belongs to neither side, so
    points at occluding borders are dropped. Depths are along the optical axis; inf means no surface.
    """
    pixel = np.flatnonzero(np.isfinite(depth_a))
    depth = depth_a.reshape(-1)[pixel].astype(np.float64)
    width_a = depth_a.shape[1]
    centres = np.stack([pixel % width_a + 0.5, pixel // width_a + 0.5, np.ones(len(pixel))], axis=1)
    in_a = centres @ np.linalg.inv(camera_a.K).T * depth[:, None]
    b_from_a = camera_b.cam_from_world @ np.linalg.inv(camera_a.cam_from_world)
    in_b = in_a @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    ahead = in_b[:, 2] > 1e-9 * depth
    pixel, in_b = pixel[ahead], in_b[ahead]
    projected = in_b @ camera_b.K.T
    xy = projected[:, :2] / projected[:, 2:]
    height, width = depth_b.shape
    # The four pixel centres around the projection must be in the image.
    low = np.floor(xy - 0.5)
    whole = (low >= 0).all(axis=1) & (low[:, 0] + 1 < width) & (low[:, 1] + 1 < height)
    pixel, in_b, xy, low = pixel[whole], in_b[whole], xy[whole], low[whole].astype(np.int64)
    share_x, share_y = (xy - 0.5 - low).T
    inverse = 1 / depth_b.astype(np.float64)
    x, y = low.T
    upper = inverse[y, x] * (1 - share_x) + inverse[y, x + 1] * share_x
    lower = inverse[y + 1, x] * (1 - share_x) + inverse[y + 1, x + 1] * share_x
    inverse_here = upper * (1 - share_y) + lower * share_y
    visible = np.abs(inverse_here * in_b[:, 2] - 1) <= tolerance
    x, y = np.floor(xy[visible]).astype(np.int64).T
    pixel_a, pixel_b = pixel[visible], y * width + x
    if len(pixel_a) > max_points:
        rows = np.linspace(0, len(pixel_a) - 1, max_points).astype(np.int64)
        pixel_a, pixel_b = pixel_a[rows], pixel_b[rows]
    return pixel_a, pixel_b


def pair_disagreement(
    labels_a: Int[np.ndarray, " P"], labels_b: Int[np.ndarray, " P"]
) -> tuple[float, float]:
    """Return two shares of point pairs that are in the same mask in one view only.

    The first share is among all pairs of points, the second among pairs in the same mask in at least one
    view; nan if there is no such pair. Points in no mask have label -1 and differ from all other points.
    """
    rows = np.unique(labels_a, return_inverse=True)[1]
    names, columns = np.unique(labels_b, return_inverse=True)
    in_mask = (labels_a != NONE) & (labels_b != NONE)
    cells = np.bincount((rows * max(1, len(names)) + columns)[in_mask])
    together_a = _pairs(np.bincount(rows[labels_a != NONE]))
    together_b = _pairs(np.bincount(columns[labels_b != NONE]))
    together_in_both = _pairs(cells)
    differ = together_a + together_b - 2 * together_in_both
    all_pairs = _pairs(np.array([len(labels_a)]))
    either = differ + together_in_both
    return differ / all_pairs if all_pairs else np.nan, differ / either if either else np.nan


def _pairs(counts: Int[np.ndarray, " n"]) -> int:
    """Return the number of pairs within groups of the given sizes."""
    counts = counts.astype(np.int64)
    return int((counts * (counts - 1) // 2).sum())


class Regions(NamedTuple):
    """Masks of one level in a view, and the row of the smallest mask at each pixel (-1: none)."""

    masks: Bool[np.ndarray, "M H W"]
    labels: Int[np.ndarray, "H W"]

    def at(self, pixels: Int64[np.ndarray, " P"]) -> tuple[Bool[np.ndarray, "M P"], Int[np.ndarray, " P"]]:
        """Return the masks and labels at some row-major pixels."""
        flat = self.masks.reshape(len(self.masks), self.labels.size)
        return flat[:, pixels], self.labels.reshape(-1)[pixels]


def view_agreement(
    a: Regions, b: Regions, pixel_a: Int64[np.ndarray, " P"], pixel_b: Int64[np.ndarray, " P"]
) -> Agreement:
    """Return the agreement of the masks of one level between two views, at shared points.

    Masks of a view may overlap. `best_iou` uses A's masks with at least `MIN_POINTS` points; the
    disagreements use the smallest mask at each point, like the language field.
    """
    (inside_a, labels_a), (inside_b, labels_b) = a.at(pixel_a), b.at(pixel_b)
    large = inside_a[inside_a.sum(axis=1) >= MIN_POINTS]
    ious = iou_matrix(large, inside_b).max(axis=1, initial=0)
    all_pairs, joined = pair_disagreement(labels_a, labels_b)
    return Agreement(len(ious), float(ious.mean()) if len(ious) else np.nan, all_pairs, joined)


def mean_agreement(parts: Sequence[Agreement]) -> Agreement:
    """Sum the counts, and average the shares over the pairs of views for which they are defined."""
    masks, *shares = zip(*parts, strict=True)
    known = [[share for share in column if share == share] for column in shares]
    return Agreement(sum(masks), *(sum(values) / len(values) if values else np.nan for values in known))


def neighbours(cameras: Cameras, views: Sequence[str], count: int) -> list[tuple[str, str]]:
    """Pair each view with its `count` nearest views by camera centre; the earlier view wins ties."""
    centres = np.array([cameras[view].centre for view in views])
    pairs = []
    for row, view in enumerate(views):
        apart = np.linalg.norm(centres - centres[row], axis=1)
        apart[row] = np.inf
        nearest = np.argsort(apart, kind="stable")[: min(count, len(views) - 1)]
        pairs += [(view, views[other]) for other in nearest]
    return pairs


def load_masks(folder: Path, view: str, size_hw: tuple[int, int]) -> HierarchicalMasks:
    """Load the masks of a view; raise MisalignedArtifactError if its labels have a different size."""
    masks = HierarchicalMasks.load(Path(folder) / f"{view}.npz")
    problem = f"the masks of view {view} do not match the size of its ground truth"
    fix = "rerun poses without shrinking the images (poses.max_side_px), then rerun masks"
    require_size(problem, masks.size_hw, size_hw, fix)
    return masks


def run_consistency(truth: Path, masks_folder: Path, out: Path, count: int = 2) -> str:
    """Measure how consistently masks of neighbouring views divide the same surface; return a Markdown table.

    Each view is compared with its `count` nearest views. The CSV has one row per level for the masks and one
    for the ground-truth regions.

    Raises:
        ArtifactError: fewer than two views have masks.
        MisalignedArtifactError: masks and ground-truth cameras differ in size.
    """
    index = read_index(masks_folder)
    views = list(index["views"])
    if len(views) < 2:
        raise ArtifactError(f"{masks_folder} has masks for {len(views)} view(s)", expected="at least two")
    cameras = Cameras.load(Path(truth) / "cameras.npz")
    surface = load_surface(Path(truth) / "mesh.ply")
    annotations = HierarchyAnnotations.load(truth)
    pairs = neighbours(cameras, views, count)

    remembered = lru_cache(maxsize=2 * count + 2)
    depth_of = remembered(lambda view: true_depth(surface, cameras[view]))
    loaded = remembered(lambda view: load_masks(masks_folder, view, cameras[view].size_hw))

    def masks_of(view: str, level: Level) -> Regions:
        masks = loaded(view)
        return Regions(masks.dense(masks.rows_of(level)), masks.label_map(level))

    def regions_of(view: str, level: Level) -> Regions:
        labels = annotations.label_image(view, level)  # surroundings are nodes too
        return Regions(labels[None] == np.unique(labels[labels >= 0])[:, None, None], labels)

    sources = {masks_label(masks_folder): masks_of, TRUTH: regions_of}
    agreements = defaultdict[tuple[str, Level], list[Agreement]](list)
    for a, b in pairs:
        pixel_a, pixel_b = shared_points(cameras[a], depth_of(a), cameras[b], depth_of(b))
        for name, of_level in sources.items():
            for level in LEVELS:
                agreement = view_agreement(of_level(a, level), of_level(b, level), pixel_a, pixel_b)
                agreements[name, level].append(agreement)
    rows = []
    for (name, level), of_pairs in agreements.items():
        mean = mean_agreement(of_pairs)
        shares = [f"{share:.4f}" for share in (mean.best_iou, mean.disagreement, mean.joined_disagreement)]
        rows.append([index["scene"], name, level.label, str(len(of_pairs)), str(mean.masks), *shares])
    write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 3)


def measure_world_consistency(
    selections: Selections,
    truths: Mapping[str, Callable[[], ViewTruth]],
    answered: Mapping[str, PackedMasks],
    truth: Path,
    settings: EvaluateSettings,
) -> Iterator[tuple[str, Measured]]:
    """Yield the rows of `world/view-consistency`, which compares annotated views with their nearest views.

    The IoU compares the answers in the two views over shared surface points; `n` is the number of points in
    the union, and texts without an answer are omitted. Nothing is yielded without a ground-truth mesh (as for
    photographed scenes). `answered` contains the stored answers by view (`views.measure_view`).
    """
    if not (truth / "mesh.ply").is_file():
        return
    scene, true = selections.scene, Cameras.load(truth / "cameras.npz")
    surface, nothing = load_surface(truth / "mesh.ply"), PackedMasks((0, 0))
    views = [view for view in scene.scene.cameras.names if view in true.names]
    nearest = dict(neighbours(true, views, 1))
    pairs = [(view, nearest[view]) for view in truths if view in nearest]
    for number, (a, b) in enumerate(pairs):
        depth_a, depth_b = (true_depth(surface, true[view]) for view in (a, b))
        pixel_a, pixel_b = shared_points(true[a], depth_a, true[b], depth_b)
        known = truths[a]()
        queries = spread(known.queries, TEXTS_PER_LEVEL)
        for method in ("field", "tree"):
            if method not in settings.methods:
                continue
            protocol = label_of(VIEW_CONSISTENCY, method, settings, known.departures)
            masks_a, masks_b = (
                answers_in_view(selections, answered.get(view, nothing), method, view, queries, settings)
                for view in (a, b)
            )
            for query, mask_a, mask_b in zip(queries, masks_a, masks_b, strict=True):
                assert query.level is not None
                seen_a, seen_b = mask_a.reshape(-1)[pixel_a], mask_b.reshape(-1)[pixel_b]
                union, level = int(np.count_nonzero(seen_a | seen_b)), query.level.label
                if union:
                    value = iou(seen_a[None], seen_b[None])
                    yield a, Measured(method, query.text, level, "view_consistency", protocol, value, union)
        for view in {a, b}.difference(*pairs[number + 1 :]):
            scene.views.cache.forget(view)


def spread(queries: Sequence[Query], per_level: int) -> list[Query]:
    """Return at most `per_level` texts per level, evenly spaced from the largest region to the smallest."""
    chosen = []
    for level in LEVELS:
        same = [query for query in queries if query.level is level]
        same.sort(key=lambda query: (-int(np.count_nonzero(query.truth)), query.text))
        count = min(per_level, len(same))
        chosen += [same[number * len(same) // count] for number in range(count)]
    return chosen


def answers_in_view(
    selections: Selections,
    stored: PackedMasks,
    method: str,
    view: str,
    queries: Sequence[Query],
    settings: EvaluateSettings,
) -> list[Bool[np.ndarray, "H W"]]:
    """Return a method's answer to each query at its level; the field's stored answers are reused."""
    scene = selections.scene
    if method == "tree":
        size_hw = scene.scene.cameras[view].size_hw
        nodes = [selections.nodes((query.text,), query.level, view) for query in queries]
        return [selections.mask(view, ids, size_hw) for ids in nodes]
    keys = [given_key(method, query) for query in queries]
    texts = [query.text for query, key in zip(queries, keys, strict=True) if key not in stored]
    missing, rule = list(dict.fromkeys(texts)), rule_of(settings)
    maps = dict(zip(missing, scene.field.relevancy(missing, view), strict=True)) if missing else {}
    return [
        stored.get(key)
        if key in stored
        else relevancy_mask(SmoothedRelevancy.of(maps[query.text], rule), query.level, rule)
        for query, key in zip(queries, keys, strict=True)
    ]
