"""Graph segmenter masks that replace the outputs of a SAM with random weights after its networks have run."""

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hilsplat.base.artifacts import read_npy, write_npy
from hilsplat.base.levels import Level
from hilsplat.segment.graph import segment_graph
from hilsplat.segment.sam import HEADS, Encoded, Frame, SamModel, in_input

SCALES = (0.07, 0.02, 0.004)  # scales that give about 300 masks per photograph
LOW_PX = 256  # side of SAM's masks
SLOPE = 5.0  # slope of the logits at a border, per pixel
REACH_PX = 8.0  # distance from a border at which the logits saturate


def labels_of(image: np.ndarray, frame: Frame) -> list[np.ndarray]:
    """Return, for each head, the region of each pixel of the network's masks; -1 for none."""
    masks, labels = segment_graph(image, SCALES, 16), []
    height, width = (side * LOW_PX // frame.padded_hw[0] for side in frame.resized_hw)
    for level in HEADS:
        low = np.full((LOW_PX, LOW_PX), -1, np.int32)
        whole = masks.label_map(Level(level)).astype(np.float32)
        low[:height, :width] = cv2.resize(whole, (width, height), interpolation=cv2.INTER_NEAREST)
        labels.append(low)
    return labels


class Regions:
    """Logits of one image's regions, in the frame of the network's masks."""

    def __init__(self, labels: list[np.ndarray], frame: Frame) -> None:
        self.scale, self.labels = LOW_PX / frame.padded_hw[0], labels
        self._known: dict[tuple[int, int], np.ndarray] = {}

    def logits(self, points: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Return predicted IoUs (P, 3) and logits (P, 3, h, w) of the regions at points in the input."""
        at = np.minimum((points * self.scale).astype(int), LOW_PX - 1)
        out = np.empty((len(points), len(HEADS), LOW_PX // step, LOW_PX // step), np.float32)
        score = np.full((len(points), len(HEADS)), 0.05, np.float32)
        for row, (x, y) in enumerate(at):
            for head, labels in enumerate(self.labels):
                label = int(labels[y, x])
                # The predicted IoU is highest for prompts in the middle of a region.
                field = self._field(head, label)
                out[row, head] = field[::step, ::step]
                if label >= 0:
                    score[row, head] = 0.9 + 0.05 * np.tanh(field[y, x] / (SLOPE * REACH_PX))
        return score, out

    def _field(self, head: int, label: int) -> np.ndarray:
        if (head, label) not in self._known:
            inside = (self.labels[head] == label).astype(np.uint8)
            if label < 0:
                self._known[head, label] = np.full(inside.shape, -SLOPE * REACH_PX, np.float32)
            else:
                near = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
                far = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 3)
                self._known[head, label] = SLOPE * np.clip(near - far, -REACH_PX, REACH_PX)
        return self._known[head, label]


def replace_outputs(model: type[SamModel], kept: Path) -> None:
    """Patch a `SamModel` so that it runs its networks but returns canned masks.

    The folder `kept` keeps the regions of images, which take longer to compute than to read.
    """
    encode, decode, preview, finish = model.encode, model.decode, model.preview, model.finish

    def canned_encode(self: Any, image: np.ndarray, *encoder: Any) -> Encoded:
        encoded = encode(self, image, *encoder)
        path = kept / f"{hashlib.sha256(image.tobytes()).hexdigest()}.npy"
        if not path.is_file():
            write_npy(path, np.stack(labels_of(image, encoded.frame)))
        encoded.features["canned"] = Regions(list(read_npy(path)), encoded.frame)  # type: ignore[index]
        return encoded

    def canned_decode(self: Any, encoded: Encoded, points_xy: np.ndarray) -> Any:
        decode(self, encoded, points_xy)
        return encoded.features["canned"].logits(in_input(points_xy, encoded.frame), 1)

    def canned_preview(self: Any, encoded: Encoded, points_xy: np.ndarray) -> Any:
        _, _, kept = preview(self, encoded, points_xy)
        points = in_input(points_xy, encoded.frame)
        return *encoded.features["canned"].logits(points, 4), {**kept, "canned": points}

    def canned_finish(self: Any, encoded: Encoded, prompts: Any) -> Any:
        if "canned" not in prompts:
            return canned_decode(self, encoded, prompts["points"])
        finish(self, encoded, prompts)
        return encoded.features["canned"].logits(prompts["canned"], 1)

    changed = {"encode": canned_encode, "decode": canned_decode}
    for name, function in (changed | {"preview": canned_preview, "finish": canned_finish}).items():
        setattr(model, name, function)
