"""Overlapping masks of one view at three levels, run-length encoded."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Int64, UInt8, UInt32

from hilsplat.base.arrays import require_types
from hilsplat.base.artifacts import read_npz, remake, write_npz
from hilsplat.base.errors import ArtifactError, EmptyMaskError
from hilsplat.base.levels import NONE, Level
from hilsplat.segment.kernels import areas_and_boxes, paint_runs, shared_pixels, window_of_runs

MAX_SIDE_PX = 2**15
LIMITS = {"level": (1, 3), "predicted_iou": (-1, 2), "stability": (0, 1)}
"""Ranges of values accepted from a file. SAM's predicted IoUs are slightly outside [0, 1]."""


def encode_runs(
    masks: Bool[np.ndarray, "M H W"],
) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M+1"]]:
    """Encode each mask as run lengths, row by row, starting with a run of False (possibly of length 0).

    Returns:
        concatenated runs, and the M + 1 offsets of each mask's runs.
    """
    runs: list[np.ndarray] = []
    offsets = np.zeros(len(masks) + 1, dtype=np.int64)
    for row, mask in enumerate(masks):
        flat = mask.reshape(-1)
        edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
        borders = np.concatenate(([0], edges, [flat.size]))
        lengths = np.diff(borders)
        if flat.size and flat[0]:
            lengths = np.concatenate(([0], lengths))
        runs.append(lengths.astype(np.uint32))
        offsets[row + 1] = offsets[row] + len(lengths)
    return (np.concatenate(runs) if runs else np.zeros(0, np.uint32)), offsets


def take_runs(
    runs: UInt32[np.ndarray, " R"], offsets: Int64[np.ndarray, " M_and_1"], rows: Int64[np.ndarray, " m"]
) -> tuple[UInt32[np.ndarray, " r"], Int64[np.ndarray, " m_and_1"]]:
    """Return the run lengths and offsets of the given rows, in the given order."""
    pieces = [runs[offsets[row] : offsets[row + 1]] for row in rows]
    taken = np.zeros(len(rows) + 1, dtype=np.int64)
    taken[1:] = np.cumsum([len(piece) for piece in pieces])
    return (np.concatenate(pieces) if pieces else np.zeros(0, np.uint32)), taken


def runs_of_labels(
    labels: Int[np.ndarray, "H W"], chosen: Int[np.ndarray, " M"]
) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M_and_1"]]:
    """Encode the regions of a label map, one mask per chosen label; each must occur in the map.

    The result equals `encode_runs` of `labels == label` for each label, but takes one pass.
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
    offsets = np.cumsum([0, *(len(piece) for piece in pieces)], dtype=np.int64)
    return np.concatenate([np.zeros(0, np.int64), *pieces]).astype(np.uint32), offsets


def join_rows(parts: Sequence[Any], ragged: str, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Concatenate the rows of several tables (at least one), field by field.

    Args:
        parts: tables with `offsets` into the field `ragged`.
        ragged: field with a variable number of values per row.
        names: the other fields to join, with one entry per row.
    """
    starts = np.cumsum([0, *(len(getattr(part, ragged)) for part in parts)])
    offsets = [part.offsets[1:] + start for part, start in zip(parts, starts[:-1], strict=True)]
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in (ragged, *names)}
    return {"offsets": np.concatenate([np.zeros(1, np.int64), *offsets]), **joined}


@dataclass(frozen=True)
class HierarchicalMasks:
    """M masks of one view; they may overlap, across and within levels.

    Attributes:
        runs: run lengths of all masks (see `encode_runs`).
        offsets: start of each mask's runs, and the end of the last ones.
        level: `Level` of each mask as the segmenter gave it.
        predicted_iou: quality of each mask as estimated by the segmenter; SAM's may slightly exceed 1.
        stability: stability of each mask under a changed threshold, in [0, 1].
        area_px: pixels of each mask.
        box_xyxy: box of each mask, px, end exclusive.
        size_hw: height and width of the view, px.
    """

    runs: UInt32[np.ndarray, " R"]
    offsets: Int64[np.ndarray, " M_and_1"]
    level: UInt8[np.ndarray, " M"]
    predicted_iou: Float32[np.ndarray, " M"]
    stability: Float32[np.ndarray, " M"]
    area_px: Int64[np.ndarray, " M"]
    box_xyxy: Int32[np.ndarray, "M 4"]
    size_hw: tuple[int, int]

    def __len__(self) -> int:
        return len(self.level)

    @staticmethod
    def from_dense(
        masks: Bool[np.ndarray, "M H W"],
        level: UInt8[np.ndarray, " M"],
        predicted_iou: Float32[np.ndarray, " M"],
        stability: Float32[np.ndarray, " M"],
    ) -> "HierarchicalMasks":
        """Pack boolean masks.

        Raises:
            EmptyMaskError: if a mask has no pixel.
        """
        runs, offsets = encode_runs(masks)
        size_hw = (int(masks.shape[1]), int(masks.shape[2]))
        return HierarchicalMasks.from_runs(runs, offsets, level, predicted_iou, stability, size_hw)

    @staticmethod
    def from_runs(
        runs: UInt32[np.ndarray, " R"],
        offsets: Int64[np.ndarray, " M_and_1"],
        level: UInt8[np.ndarray, " M"],
        predicted_iou: Float32[np.ndarray, " M"],
        stability: Float32[np.ndarray, " M"],
        size_hw: tuple[int, int],
    ) -> "HierarchicalMasks":
        """Build masks from run lengths; areas and boxes are computed.

        Raises:
            EmptyMaskError: if a mask has no pixel.
        """
        area_px, boxes = areas_and_boxes(runs, offsets, size_hw[1])
        if not area_px.all():
            raise EmptyMaskError(
                f"masks {np.flatnonzero(area_px == 0).tolist()} of {len(area_px)} have no pixel",
                fix="drop empty masks before packing",
            )
        return HierarchicalMasks(
            runs,
            offsets,
            level.astype(np.uint8),
            predicted_iou.astype(np.float32),
            stability.astype(np.float32),
            area_px,
            boxes,
            size_hw,
        )

    def dense(self, rows: Int64[np.ndarray, " m"] | None = None) -> Bool[np.ndarray, "m H W"]:
        """Decode all masks, or the given rows, to booleans."""
        rows = np.arange(len(self)) if rows is None else np.asarray(rows)
        height, width = self.size_hw
        masks = np.empty((len(rows), height * width), dtype=bool)
        for out, row in enumerate(rows):
            lengths = self.runs[self.offsets[row] : self.offsets[row + 1]]
            masks[out] = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
        return masks.reshape(len(rows), height, width)

    def window(self, row: int, box_xyxy: tuple[int, int, int, int]) -> Bool[np.ndarray, "h w"]:
        """Decode one mask inside a box of the view (xyxy, end exclusive)."""
        runs = self.runs[self.offsets[row] : self.offsets[row + 1]]
        return window_of_runs(runs, self.size_hw[1], box_xyxy)

    def overlaps_px(self) -> Int64[np.ndarray, "M M"]:
        """Return the exact number of pixels that each pair of masks shares."""
        return shared_pixels(self.runs, self.offsets, self.box_xyxy, *self.size_hw)

    def take(self, rows: Int64[np.ndarray, " m"]) -> "HierarchicalMasks":
        """Return the given rows, in the given order."""
        return HierarchicalMasks(
            *take_runs(self.runs, self.offsets, rows),
            self.level[rows],
            self.predicted_iou[rows],
            self.stability[rows],
            self.area_px[rows],
            self.box_xyxy[rows],
            self.size_hw,
        )

    @staticmethod
    def concatenate(parts: "list[HierarchicalMasks]", size_hw: tuple[int, int]) -> "HierarchicalMasks":
        """Concatenate the rows of all parts; `size_hw` is the view's size, px."""
        empty = HierarchicalMasks.from_dense(
            np.zeros((0, *size_hw), bool),
            np.zeros(0, np.uint8),
            np.zeros(0, np.float32),
            np.zeros(0, np.float32),
        )
        names = ("level", "predicted_iou", "stability", "area_px", "box_xyxy")
        return HierarchicalMasks(size_hw=size_hw, **join_rows([empty, *parts], "runs", names))

    def content_order(self) -> Int64[np.ndarray, " M"]:
        """Return the rows sorted by content: level, decreasing area, box, predicted IoU, stability, runs.

        The order does not depend on row numbers, so a segmenter that sorts by it writes the same file for any
        order of prompts.
        """
        keys = [
            (
                int(self.level[row]),
                -int(self.area_px[row]),
                tuple(self.box_xyxy[row].tolist()),
                -float(self.predicted_iou[row]),
                -float(self.stability[row]),
                self.runs[self.offsets[row] : self.offsets[row + 1]].tobytes(),
            )
            for row in range(len(self))
        ]
        return np.array(sorted(range(len(self)), key=keys.__getitem__), dtype=np.int64)

    def rows_of(self, level: Level) -> Int64[np.ndarray, " m"]:
        """Return the rows of a level, in order."""
        return np.flatnonzero(self.level == int(level))

    def label_map(self, level: Level | None) -> Int32[np.ndarray, "H W"]:
        """Paint the masks of a level (None: all), large to small, so that small ones stay visible.

        Returns:
            row of the mask at each pixel, or -1 where there is none. Of two equally large masks the
            lower row is painted last.
        """
        labels = np.full(self.size_hw, NONE, dtype=np.int32)
        rows = np.arange(len(self)) if level is None else self.rows_of(level)
        order = rows[np.lexsort((-rows, -self.area_px[rows]))]
        paint_runs(self.runs, self.offsets, order, labels.reshape(-1))
        return labels

    def save(self, path: Path) -> None:
        """Write `<view>.npz` atomically."""
        write_npz(path, **self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all fields as plain arrays."""
        return {
            "runs": self.runs,
            "offsets": self.offsets,
            "level": self.level,
            "predicted_iou": self.predicted_iou,
            "stability": self.stability,
            "area_px": self.area_px,
            "box_xyxy": self.box_xyxy,
            "size_hw": np.array(self.size_hw, dtype=np.int32),
        }

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "HierarchicalMasks":
        """Build masks from the result of `arrays`."""
        fields = dict(arrays)
        height, width = fields.pop("size_hw")
        return HierarchicalMasks(**fields, size_hw=(int(height), int(width)))

    @staticmethod
    def load(path: Path) -> "HierarchicalMasks":
        """Read `<view>.npz` and validate it.

        Raises:
            ArtifactError: if it is missing or damaged, or its arrays contradict each other.
        """
        arrays = read_npz(path, *(field.name for field in fields(HierarchicalMasks)))
        size = arrays["size_hw"]
        is_size = size.shape == (2,) and size.dtype.kind in "iu"
        if not is_size or size.min() < 1 or size.max() > MAX_SIDE_PX:
            raise _damaged(path, "size_hw", f"two sides from 1 to {MAX_SIDE_PX} px", str(size.tolist()))
        require_types(HierarchicalMasks, arrays, path, LIMITS)
        try:
            found = HierarchicalMasks.from_arrays(arrays)
        except TypeError as error:
            raise _damaged(path, "names", "those of masks", str(error)) from error
        found._require_whole(path)
        return found

    def _require_whole(self, path: Path) -> None:
        lengths = np.diff(self.offsets)
        if len(self.offsets) != len(self) + 1 or self.offsets[0] != 0 or self.offsets[-1] != len(self.runs):
            ends = f"{len(self.offsets)} from {self.offsets[:1].tolist()} to {self.offsets[-1:].tolist()}"
            raise _damaged(path, "offsets", f"{len(self) + 1} from 0 to {len(self.runs)}", ends)
        if (lengths <= 0).any():
            raise _damaged(path, "offsets", "ascending offsets", f"steps of {int(lengths.min())}")
        height, width = self.size_hw
        if len(self):
            pixels = np.add.reduceat(self.runs.astype(np.int64), self.offsets[:-1])
            if (pixels != height * width).any():
                wrong = int(pixels[pixels != height * width][0])
                raise _damaged(path, "runs", f"{height * width} pixels a mask", f"{wrong} in one")
        area_px, boxes = areas_and_boxes(self.runs, self.offsets, width)
        if not (area_px > 0).all() or not np.array_equal(area_px, self.area_px):
            raise _damaged(path, "area_px", "the areas of the masks", "others")
        if not np.array_equal(boxes, self.box_xyxy):
            raise _damaged(path, "box_xyxy", "the boxes of the masks", "others")


def _damaged(path: Path, name: str, expected: str, found: str) -> ArtifactError:
    return ArtifactError(
        f"{path}: array {name} cannot be right", expected=expected, found=found, fix=remake(path)
    )
