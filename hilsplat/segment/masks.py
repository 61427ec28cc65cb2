"""Overlapping masks of one view at three levels, run-length encoded."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Int64, UInt8, UInt32

from hilsplat.base.arrays import build_checked, impossible, require_types
from hilsplat.base.artifacts import read_npz, write_npz
from hilsplat.base.errors import HilsplatError
from hilsplat.base.levels import NONE, Level
from hilsplat.segment.kernels import areas_and_boxes, paint_runs, shared_pixels

MAX_SIDE_PX = 2**15
LIMITS = {"level": (1, 3), "predicted_iou": (-1, 2), "stability": (0, 1)}
"""Ranges of values accepted from a file. SAM's predicted IoUs may be slightly outside [0, 1]."""


def encode_runs(
    masks: Bool[np.ndarray, "M H W"],
) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M+1"]]:
    """Encode each mask as run lengths, row by row, starting with a run of False (possibly of length 0)."""
    pieces = []
    for mask in masks:
        flat = mask.reshape(-1)
        edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
        lengths = np.diff(edges, prepend=0, append=flat.size)
        pieces.append(np.insert(lengths, 0, 0) if flat.size and flat[0] else lengths)
    return _joined(pieces)


def _joined(pieces: Sequence[np.ndarray]) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M_and_1"]]:
    """Concatenate the runs of each mask, and return them with their offsets."""
    offsets = np.cumsum([0, *(len(piece) for piece in pieces)], dtype=np.int64)
    return np.concatenate([np.zeros(0, np.uint32), *pieces], dtype=np.uint32, casting="unsafe"), offsets


def take_runs(
    runs: UInt32[np.ndarray, " R"], offsets: Int64[np.ndarray, " M_and_1"], rows: Int64[np.ndarray, " m"]
) -> tuple[UInt32[np.ndarray, " r"], Int64[np.ndarray, " m_and_1"]]:
    """Return the run lengths and offsets of the given rows, in the given order."""
    return _joined([runs[offsets[row] : offsets[row + 1]] for row in rows])


def runs_of_labels(
    labels: Int[np.ndarray, "H W"], chosen: Int[np.ndarray, " M"]
) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M_and_1"]]:
    """Encode the regions of a label map, one mask per chosen label; each label must occur in the map.

    The result equals `encode_runs` of `labels == label` for each label, but is computed in one pass.
    """
    flat = labels.reshape(-1)
    borders = np.concatenate(([0], np.flatnonzero(flat[1:] != flat[:-1]) + 1, [flat.size]))
    starts, stops, owner = borders[:-1], borders[1:], flat[borders[:-1]]
    order = np.argsort(owner, kind="stable")
    first, last = (np.searchsorted(owner[order], chosen, side=side) for side in ("left", "right"))
    pieces = []
    for low, high in zip(first, last, strict=True):
        mine = order[low:high]
        edges = np.stack([starts[mine], stops[mine]], axis=1).reshape(-1)
        lengths = np.diff(edges, prepend=0)
        pieces.append(lengths if edges[-1] == flat.size else np.append(lengths, flat.size - edges[-1]))
    return _joined(pieces)


def join_rows(parts: Sequence[Any], ragged: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Concatenate the rows of several tables (at least one), field by field.

    The field `ragged` has several values per row, delimited by `offsets`; fields in `names` have one per row.
    """
    starts = np.cumsum([0, *(len(getattr(part, ragged)) for part in parts)])
    offsets = [part.offsets[1:] + start for part, start in zip(parts, starts[:-1], strict=True)]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (ragged, *names)}
    return {"offsets": np.concatenate([np.zeros(1, np.int64), *offsets]), **joined}


PER_MASK = ("level", "predicted_iou", "stability", "area_px", "box_xyxy")
"""Fields of `HierarchicalMasks` with one entry per mask."""


@dataclass(frozen=True, eq=False)
class HierarchicalMasks:
    """M masks of one view; they may overlap, across and within levels."""

    runs: UInt32[np.ndarray, " R"]  # run lengths of all masks (`encode_runs`)
    offsets: Int64[np.ndarray, " M_and_1"]  # start of each mask's runs, and the end of the last mask's runs
    level: UInt8[np.ndarray, " M"]  # `Level` of each mask
    predicted_iou: Float32[np.ndarray, " M"]  # as predicted by the segmenter; SAM's may slightly exceed 1
    stability: Float32[np.ndarray, " M"]  # stability under a changed threshold, in [0, 1]
    area_px: Int64[np.ndarray, " M"]
    box_xyxy: Int32[np.ndarray, "M 4"]  # px, end exclusive
    size_hw: tuple[int, int]  # of the view, px

    def __len__(self) -> int:
        return len(self.level)

    def __repr__(self) -> str:
        return f"HierarchicalMasks({len(self)} masks of {self.size_hw[1]} x {self.size_hw[0]} px)"

    @staticmethod
    def from_dense(
        masks: Bool[np.ndarray, "M H W"],
        level: UInt8[np.ndarray, " M"],
        predicted_iou: Float32[np.ndarray, " M"],
        stability: Float32[np.ndarray, " M"],
    ) -> "HierarchicalMasks":
        """Pack boolean masks; errors as in `from_runs`."""
        size_hw = (int(masks.shape[1]), int(masks.shape[2]))
        return HierarchicalMasks.from_runs(*encode_runs(masks), level, predicted_iou, stability, size_hw)

    @staticmethod
    def from_runs(
        runs: UInt32[np.ndarray, " R"],
        offsets: Int64[np.ndarray, " M_and_1"],
        level: UInt8[np.ndarray, " M"] | Level,
        predicted_iou: Float32[np.ndarray, " M"],
        stability: Float32[np.ndarray, " M"],
        size_hw: tuple[int, int],
    ) -> "HierarchicalMasks":
        """Build masks of given levels, or of one level; raise a HilsplatError if a mask is empty."""
        area_px, boxes = areas_and_boxes(runs, offsets, size_hw[1])
        if not area_px.all():
            raise HilsplatError(
                f"masks {np.flatnonzero(area_px == 0).tolist()} of {len(area_px)} contain no pixels",
                fix="drop empty masks before packing",
            )
        levels = np.full(len(area_px), level, np.uint8)
        return HierarchicalMasks(runs, offsets, levels, predicted_iou, stability, area_px, boxes, size_hw)

    def dense(self, rows: Int64[np.ndarray, " m"] | None = None) -> Bool[np.ndarray, "m H W"]:
        """Decode all masks, or the given rows, to booleans."""
        rows = np.arange(len(self)) if rows is None else rows
        height, width = self.size_hw
        masks = np.empty((len(rows), height * width), dtype=bool)
        for out, row in enumerate(rows.tolist()):
            masks[out] = self.window(row, (0, 0, width, height)).reshape(-1)
        return masks.reshape(len(rows), height, width)

    def window(self, row: int, box_xyxy: tuple[int, int, int, int]) -> Bool[np.ndarray, "h w"]:
        """Decode one mask inside a box of the view (xyxy, end exclusive)."""
        x0, y0, x1, y1 = box_xyxy
        width = self.size_hw[1]
        ends = np.cumsum(self.runs[self.offsets[row] : self.offsets[row + 1]], dtype=np.int64)
        lengths = np.diff(ends.clip(y0 * width, y1 * width), prepend=y0 * width)  # within the box's rows
        band = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
        return band.reshape(y1 - y0, width)[:, x0:x1]

    def overlaps_px(self) -> Int64[np.ndarray, "M M"]:
        """Return the exact number of pixels shared by each pair of masks."""
        return shared_pixels(self.runs, self.offsets, self.box_xyxy, *self.size_hw)

    def take(self, rows: Int64[np.ndarray, " m"]) -> "HierarchicalMasks":
        """Return the given rows, in the given order."""
        runs, offsets = take_runs(self.runs, self.offsets, rows)
        others = {name: getattr(self, name)[rows] for name in PER_MASK}
        return replace(self, runs=runs, offsets=offsets, **others)

    @staticmethod
    def concatenate(parts: "list[HierarchicalMasks]") -> "HierarchicalMasks":
        """Concatenate the rows of all parts (at least one)."""
        return HierarchicalMasks(size_hw=parts[0].size_hw, **join_rows(parts, "runs", PER_MASK))

    def content_order(self) -> Int64[np.ndarray, " M"]:
        """Return the rows sorted by content: level, decreasing area, box, predicted IoU, stability, runs.

        The order does not depend on row numbers, so a segmenter that sorts its masks this way writes the same
        file for any order of prompts.
        """

        def key(row: int) -> tuple[Any, ...]:
            scores = -float(self.predicted_iou[row]), -float(self.stability[row])
            runs = self.runs[self.offsets[row] : self.offsets[row + 1]].tobytes()
            return int(self.level[row]), -int(self.area_px[row]), self.box_xyxy[row].tolist(), *scores, runs

        return np.array(sorted(range(len(self)), key=key), dtype=np.int64)

    def rows_of(self, level: Level | str) -> Int64[np.ndarray, " m"]:
        """Return the rows of a level, in order; raise SettingsError if there is no such level."""
        return np.flatnonzero(self.level == Level.of(level))

    def label_map(self, level: Level | str | None) -> Int32[np.ndarray, "H W"]:
        """Return the row of the mask visible at each pixel (-1: none), for one level or all levels (None).

        Large masks are painted first, so small masks stay visible. For the same area, the lower row wins.
        """
        labels = np.full(self.size_hw, NONE, dtype=np.int32)
        rows = np.arange(len(self)) if level is None else self.rows_of(level)
        order = rows[np.lexsort((-rows, -self.area_px[rows]))]
        paint_runs(self.runs, self.offsets, order, labels.reshape(-1))
        return labels

    def save(self, path: Path) -> None:
        """Write `<view>.npz` atomically."""
        require_types(HierarchicalMasks, vars(self), path, LIMITS)
        self._require_whole(path)
        write_npz(path, **self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all fields as plain arrays."""
        return {**vars(self), "size_hw": np.array(self.size_hw, dtype=np.int32)}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "HierarchicalMasks":
        """Build masks from the result of `arrays`."""
        others = dict(arrays)
        height, width = others.pop("size_hw").tolist()
        return HierarchicalMasks(**others, size_hw=(height, width))

    @staticmethod
    def load(path: Path) -> "HierarchicalMasks":
        """Read `<view>.npz`; raise an ArtifactError if it is missing, damaged or inconsistent."""
        arrays = read_npz(path, "size_hw")
        size = arrays.pop("size_hw")
        is_size = size.shape == (2,) and size.dtype.kind in "iu"
        if not is_size or size.min() < 1 or size.max() > MAX_SIDE_PX:
            raise impossible(path, "size_hw", f"two sides from 1 to {MAX_SIDE_PX} px", str(size.tolist()))
        masks = build_checked(HierarchicalMasks, arrays, {"size_hw": tuple(size.tolist())}, path, LIMITS)
        masks._require_whole(path)
        return masks

    def _require_whole(self, path: Path) -> None:
        """Check that offsets, runs, areas and boxes are consistent."""
        lengths, ends = np.diff(self.offsets), self.offsets[[0, -1]].tolist() if len(self.offsets) else []
        if len(self.offsets) != len(self) + 1 or ends != [0, len(self.runs)] or (lengths <= 0).any():
            offsets = f"{len(self.offsets)} from {ends}, smallest step {lengths.min(initial=0)}"
            raise impossible(
                path, "offsets", f"{len(self) + 1} ascending from 0 to {len(self.runs)}", offsets
            )
        height, width = self.size_hw
        if len(self):
            pixels = np.add.reduceat(self.runs.astype(np.int64), self.offsets[:-1])
            if (pixels != height * width).any():
                wrong = f"{pixels[pixels != height * width][0]} in one mask"
                raise impossible(path, "runs", f"{height * width} pixels per mask", wrong)
        area_px, boxes = areas_and_boxes(self.runs, self.offsets, width)
        if not (area_px > 0).all() or not np.array_equal(area_px, self.area_px):
            raise impossible(path, "area_px", "the areas of the masks")
        if not np.array_equal(boxes, self.box_xyxy):
            raise impossible(path, "box_xyxy", "the boxes of the masks")


def region_ious(
    labels: Int[np.ndarray, "H W"], masks: Bool[np.ndarray, "M H W"]
) -> tuple[Int64[np.ndarray, " R"], Int64[np.ndarray, " R"], Float32[np.ndarray, "R M"]]:
    """Return the ids of a label image's regions, their areas (px) and their IoUs with every mask.

    Ids are in ascending order. Labels are negative where there is no region; masks may overlap.
    """
    flat = labels.reshape(-1)
    ids, index = np.unique(flat, return_inverse=True)
    first = int(np.searchsorted(ids, 0))
    areas = np.bincount(index, minlength=len(ids))
    flat_masks = masks.reshape(len(masks), flat.size)
    shared = np.zeros((len(ids), len(masks)))
    for row, mask in enumerate(flat_masks):
        shared[:, row] = np.bincount(index[mask], minlength=len(ids))
    union = areas[:, None] + flat_masks.sum(axis=1)[None] - shared
    ious = (shared / np.maximum(union, 1)).astype(np.float32)
    return ids[first:].astype(np.int64), areas[first:].astype(np.int64), ious[first:]
