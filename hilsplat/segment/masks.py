"""Overlapping masks of one view at three levels, run-length coded."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, UInt8, UInt32

from hilsplat.base.artifacts import read_npz, write_npz
from hilsplat.base.errors import EmptyMaskError
from hilsplat.base.levels import NONE, Level


def encode_runs(
    masks: Bool[np.ndarray, "M H W"],
) -> tuple[UInt32[np.ndarray, " R"], Int64[np.ndarray, " M+1"]]:
    """Run lengths of each mask, row by row, starting with a run of False (possibly 0 long).

    Returns:
        all runs one after the other, and the M + 1 offsets at which each mask's runs begin.
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


@dataclass(frozen=True)
class HierarchicalMasks:
    """M masks of one view; they may overlap, across and within levels.

    Attributes:
        runs: run lengths of all masks (see `encode_runs`).
        offsets: where each mask's runs begin.
        level: `Level` of each mask as the segmenter gave it.
        predicted_iou: the segmenter's own estimate of each mask's quality, in [0, 1].
        stability: stability of each mask under a changed threshold, in [0, 1].
        area_px: pixels of each mask.
        box_xyxy: box of each mask, px, end exclusive.
        size_hw: height and width of the view, px.
    """

    runs: UInt32[np.ndarray, " R"]
    offsets: Int64[np.ndarray, " M+1"]
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
            EmptyMaskError: a mask has no pixel.
        """
        area_px = masks.sum(axis=(1, 2), dtype=np.int64)
        if not area_px.all():
            raise EmptyMaskError(
                f"masks {np.flatnonzero(area_px == 0).tolist()} of {len(masks)} have no pixel",
                fix="drop empty masks before packing",
            )
        boxes = np.zeros((len(masks), 4), dtype=np.int32)
        for row, mask in enumerate(masks):
            ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            boxes[row] = xs[0], ys[0], xs[-1] + 1, ys[-1] + 1
        runs, offsets = encode_runs(masks)
        return HierarchicalMasks(
            runs,
            offsets,
            level.astype(np.uint8),
            predicted_iou.astype(np.float32),
            stability.astype(np.float32),
            area_px,
            boxes,
            (int(masks.shape[1]), int(masks.shape[2])),
        )

    def dense(self, rows: Int64[np.ndarray, " m"] | None = None) -> Bool[np.ndarray, "m H W"]:
        """Unpack all masks, or the given rows, to booleans."""
        rows = np.arange(len(self)) if rows is None else np.asarray(rows)
        height, width = self.size_hw
        masks = np.zeros((len(rows), height * width), dtype=bool)
        for out, row in enumerate(rows):
            lengths = self.runs[self.offsets[row] : self.offsets[row + 1]].astype(np.int64)
            ends = np.cumsum(lengths)
            for start, end in zip(ends[0::2], ends[1::2], strict=False):
                masks[out, start:end] = True
        return masks.reshape(len(rows), height, width)

    def rows_of(self, level: Level) -> Int64[np.ndarray, " m"]:
        """Rows of a level, in order."""
        return np.flatnonzero(self.level == int(level))

    def label_map(self, level: Level) -> Int32[np.ndarray, "H W"]:
        """Paint the level's masks, large to small, so that small ones stay visible.

        Returns:
            row of the mask at each pixel, -1 where there is none. Of two equally large masks the
            lower row is painted last.
        """
        labels = np.full(self.size_hw, NONE, dtype=np.int32)
        rows = self.rows_of(level)
        order = rows[np.lexsort((-rows, -self.area_px[rows]))]
        for row in order:
            labels[self.dense(np.array([row]))[0]] = row
        return labels

    def save(self, path: Path) -> None:
        """Write `<view>.npz` atomically."""
        write_npz(path, **self.arrays())

    def arrays(self) -> dict[str, np.ndarray]:
        """All fields as plain arrays."""
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
        """Inverse of `arrays`."""
        fields = dict(arrays)
        height, width = fields.pop("size_hw")
        return HierarchicalMasks(**fields, size_hw=(int(height), int(width)))

    @staticmethod
    def load(path: Path) -> "HierarchicalMasks":
        """Read `<view>.npz`."""
        return HierarchicalMasks.from_arrays(read_npz(path))
