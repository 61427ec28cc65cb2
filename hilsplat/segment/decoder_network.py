"""SAM's prompt encoder and mask decoder as exported: prompts along any axis, and without boxes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float32

from hilsplat.base.errors import ModelError
from hilsplat.models.card import CPU
from hilsplat.models.folder import ModelFolder
from hilsplat.models.network import Array
from hilsplat.models.onnx_graph import Graph, computed_from, reads_through, without_joined
from hilsplat.models.repeatable import require_repeatable

POINTS, LABELS, BOXES = "input_points", "input_labels", "input_boxes"
INSIDE, OUTSIDE, PADDING = 1, 0, -1  # labels of points. SAM adds one padding point to prompts without a box.


def repeated(value: Array, number: int) -> Array:
    """Repeat an array along the first axis."""
    is_array = isinstance(value, np.ndarray)
    return np.repeat(value, number, axis=0) if is_array else value.expand(number, -1, -1, -1)


class DecoderNetwork:
    """A mask decoder whose calls decode several prompts on one image.

    Attributes:
        graph: the network without boxes.
        axis: axis of `input_points` along which prompts are passed: 1, or 0 if axis 1 has length 1.
        pads: whether calls add the padding point, because the network itself doesn't.
        prompts_per_call: required number of prompts per call; None for any number.
    """

    def __init__(self, model: ModelFolder, name: str, device: str = CPU) -> None:
        self.graph = Graph.read(model.networks[name])
        without_boxes = without_joined(self.graph, BOXES, POINTS)
        self.graph = without_boxes or self.graph
        self.network = model.network(name, without_boxes, device)
        self.pads = without_boxes is not None and not reads_through(self.graph, LABELS, ("Concat", "Pad"))
        problem = "requires a box with each prompt" if self._needs_boxes() else ""
        if self.pads and LABELS not in self.network.inputs:
            problem = f"accepts boxes, but no {LABELS}"
        if problem:
            raise ModelError(
                f"network {self.network.path} {problem}",
                expected=f"a decoder for {POINTS} and {LABELS}, with or without {BOXES}",
                fix="use another model or variant (docs/models.md)",
            )
        along_first = self.network.fixed_axis(POINTS, 1) == 1 and self.network.fixed_axis(POINTS, 0) != 1
        self.axis = 0 if along_first else 1
        self.prompts_per_call = self.network.fixed_axis(POINTS, self.axis)
        if self.prompts_per_call is None and self.axis == 0 and device == CPU:
            # each of 8 prompts in a call, with its own copy of the image, takes 1.6 times as long
            self.prompts_per_call = 1

    def _needs_boxes(self) -> bool:
        """Return whether the network accepts only a fixed number of boxes, and its results depend on them."""
        outputs = {value.name for value in self.graph.model.graph.output}
        if BOXES not in self.network.inputs or not self.network.fixed_axis(BOXES, 1):
            return False
        return bool(outputs & computed_from(self.graph, BOXES))

    def feeds(
        self,
        features: Mapping[str, Array],
        points_xy: Float[np.ndarray, "P K 2"],
        inside: Bool[np.ndarray, "P K"] | None = None,
    ) -> dict[str, Array]:
        """Return the network's inputs for prompts of K points (px of its input), by default all inside."""
        labels = np.where(np.ones(points_xy.shape[:2], bool) if inside is None else inside, INSIDE, OUTSIDE)
        if self.pads:
            points_xy = np.pad(points_xy, ((0, 0), (0, 1), (0, 0)))
            labels = np.pad(labels, ((0, 0), (0, 1)), constant_values=PADDING)
        images = len(points_xy) if self.axis == 0 else 1
        boxes = self.network.fixed_axis(BOXES, 1) if BOXES in self.network.inputs else None
        feeds: dict[str, Array] = {
            POINTS: np.expand_dims(points_xy, 1 - self.axis).astype(np.float32),
            LABELS: np.expand_dims(labels, 1 - self.axis).astype(np.int64),
            BOXES: np.zeros((images, boxes or 0, 4), np.float32),
        }
        for name, value in features.items():
            is_single = len(value) == images or self.network.fixed_axis(name, 0) == 1
            feeds[name] = value if is_single else repeated(value, images)
        return feeds

    def __call__(
        self,
        features: Mapping[str, Array],
        points_xy: Float[np.ndarray, "P K 2"],
        inside: Bool[np.ndarray, "P K"] | None = None,
    ) -> tuple[Float32[Array, "P 3"], Float32[Array, "P 3 h w"]]:
        """Return predicted IoUs and logits of each prompt; inputs as in `feeds`."""
        if inside is not None and not inside.all() and LABELS not in self.network.inputs:
            raise ModelError(
                f"network {self.network.path} accepts no points outside an object",
                expected=f"an input {LABELS}",
                fix="use only points inside the object, or another model",
            )
        outputs = self.network.run(**self.feeds(features, points_xy, inside))
        scores, logits = (output.swapaxes(0, 1 - self.axis)[0] for output in outputs)
        return scores, logits

    def require_repeatable(self, features: Mapping[str, Array], side_px: int) -> None:
        """Raise a ModelError if the network's results for the same prompts differ between calls."""
        points = np.full((self.prompts_per_call or 1, 1, 2), side_px / 2)
        require_repeatable(self.network, self.feeds(features, points), self.feeds(features, points / 2))
