"""Outlines around clicks or a box, by the SAM model that made a scene's masks."""

from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from hilsplat.annotate.labels import traced
from hilsplat.annotate.proposals import Proposal, cleaned
from hilsplat.base.artifacts import read_index
from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import Level
from hilsplat.scene.scene import Scene
from hilsplat.segment.sam import HEADS, Encoded, SamModel, enlarged

KEPT_VIEWS = 3
"""Number of photographs whose features are cached: 4 MB each for SAM ViT-B, up to 40 MB for SAM 2."""
BOX_GRID = 4
"""Prompt points along each side of a box, because not all SAM exports accept boxes."""
OFFERED = 3
SAME_IOU = 0.9
"""Masks with at least this IoU count as the same mask."""


class Clicks:
    """The SAM model named in the index of a scene's masks, opened at the first click. Not thread-safe."""

    def __init__(self, scene: Scene, masks: Path) -> None:
        self.scene = scene
        index = read_index(masks) if (masks / "index.json").is_file() else {}
        self.folder: str = index.get("model") or "" if index.get("segmenter") == "sam" else ""
        self._encoded: OrderedDict[str, Encoded] = OrderedDict()

    @property
    def name(self) -> str:
        """Name of the model; empty if the scene's masks were made without SAM."""
        return Path(self.folder).name

    @cached_property
    def model(self) -> SamModel:
        """The model."""
        if not self.folder:
            raise SettingsError(
                "the masks of this scene were made without a SAM", fix="draw, or compute masks by a SAM"
            )
        return SamModel.load(Path(self.folder))

    def encoded(self, view: str) -> Encoded:
        """Return the features of a photograph, cached for the last `KEPT_VIEWS` photographs."""
        if view not in self._encoded:
            self._encoded[view] = self.model.encode(self.scene.image(view))
            while len(self._encoded) > KEPT_VIEWS:
                self._encoded.popitem(last=False)
        self._encoded.move_to_end(view)
        return self._encoded[view]

    def outlines(
        self, view: str, clicks: Sequence[tuple[int, int, bool]], box: tuple[int, int, int, int] | None
    ) -> list[Proposal]:
        """Return the outlines of the thing at clicks or in a box, best first.

        Masks are ranked by the number of clicks that they satisfy, then by SAM's predicted IoU, times the
        IoU of their box with the given box.

        Args:
            view: name of the photograph's view.
            clicks: x, y, and whether the pixel is inside the thing.
            box: left, top, right, bottom, inclusive; only without clicks.

        Raises:
            SettingsError: nothing is clicked inside the photograph, or the scene has no SAM.
        """
        height, width = self.scene.cameras[view].size_hw
        points = np.array([[x + 0.5, y + 0.5] for x, y, _ in clicks]).reshape(-1, 2)
        inside = np.array([each for *_, each in clicks], np.bool_)
        corners = np.array(box if box else (0, 0, 0, 0))
        if not (inside.any() or box) or (points < 0).any() or (points > (width, height)).any():
            raise SettingsError("no pixel of the thing is clicked", expected="one inside the photograph")
        encoded = self.encoded(view)
        asked = points[inside] if clicks else _grid(corners)
        iou, logits = self.model.decode(encoded, asked)
        iou, logits = iou.reshape(-1), logits.reshape(-1, *logits.shape[2:])
        if len(clicks) > 1:  # all clicks as one prompt
            more_iou, more = self.model.decode_clicks(encoded, points, inside)
            iou, logits = np.concatenate([more_iou, iou]), np.concatenate([more, logits])
        masks = enlarged(logits, encoded.frame)
        columns, rows = points.astype(np.int64).T if clicks else (np.zeros(0, np.int64),) * 2
        right = (masks[:, rows, columns] == inside).sum(axis=1)
        fits = iou * [_box_iou(mask, corners) for mask in masks] if box else iou
        kept: dict[int, Level] = {}  # the coarsest level among masks that count as the same
        for row in np.lexsort((-fits, -right)).tolist():
            level = HEADS[row % len(HEADS)]
            same = [other for other in kept if _iou(masks[row], masks[other]) >= SAME_IOU]
            for other in same:
                kept[other] = min(kept[other], level)
            if not same and len(kept) < OFFERED:
                kept[row] = level
        return [
            Proposal(f"by {self.name}", "", int(level), traced(mask))
            for row, level in kept.items()
            if (mask := cleaned(masks[row])).any()
        ]


def _grid(box: np.ndarray) -> np.ndarray:
    """Return points inside a box, (BOX_GRID**2, 2)."""
    steps = (np.arange(BOX_GRID) + 0.5) / BOX_GRID
    x, y = np.meshgrid(box[0] + steps * (box[2] + 1 - box[0]), box[1] + steps * (box[3] + 1 - box[1]))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def _box_iou(mask: Bool[np.ndarray, "H W"], box: np.ndarray) -> float:
    if not mask.any():
        return 0.0
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    own = np.array([columns[0], rows[0], columns[-1], rows[-1]])
    low, high = np.maximum(own[:2], box[:2]), np.minimum(own[2:], box[2:]) + 1
    common = np.prod(np.maximum(high - low, 0))
    areas = [np.prod(each[2:] - each[:2] + 1) for each in (own, box)]
    return float(common / (sum(areas) - common))


def _iou(one: Bool[np.ndarray, "H W"], other: Bool[np.ndarray, "H W"]) -> float:
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 1.0
