"""Segment Anything in onnxruntime: one image in, three masks per point prompt out.

Images are resized and masks restored as by SamProcessor of the transformers library, whose ONNX
exports are read here. The rounding of logits (`read_logits`) is ours.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int8, Int32, Int64, UInt8
from PIL import Image

from hilsplat.base.levels import Level
from hilsplat.base.onnx_models import ModelFolder, open_model_folder, require_three_heads, side_px
from hilsplat.segment.logit_kernels import quantise_logits

HEADS: tuple[Level, Level, Level] = (Level.SUBPART, Level.PART, Level.WHOLE)
"""What the decoder's three outputs mean, in its order: fine to coarse."""

LOGIT_STEP = 1 / 8
"""Logits are rounded to this step and clipped to +-127 steps, so that the candidates of a view fit in a few
MB of cache. A border moves by less than a hundredth of a low-resolution pixel if the logit changes by 5 per
pixel, as it does at SAM's borders."""


@dataclass(frozen=True)
class Frame:
    """How an image sits in the network's square input.

    Attributes:
        original_hw: the image, px.
        resized_hw: its size in the input, at the top left, px.
        padded_hw: the whole input, px.
    """

    original_hw: tuple[int, int]
    resized_hw: tuple[int, int]
    padded_hw: tuple[int, int]


@dataclass(frozen=True)
class Encoded:
    """One image after the vision encoder."""

    embeddings: Float32[np.ndarray, "1 C h w"]
    positional: Float32[np.ndarray, "1 D h w"]
    frame: Frame


def resized_size(original_hw: tuple[int, int], longest_edge: int) -> tuple[int, int]:
    """Height and width whose longer side is `longest_edge`; halves are rounded up, as in SamProcessor.

    Departs: neither becomes 0, however thin the image is.
    """
    scale = longest_edge / max(original_hw)
    return max(1, int(original_hw[0] * scale + 0.5)), max(1, int(original_hw[1] * scale + 0.5))


def point_grid(points_per_side: int) -> Float[np.ndarray, "P 2"]:
    """Centres of a grid of squares over the unit square, as (x, y), row by row."""
    centres = (np.arange(points_per_side) + 0.5) / points_per_side
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.reshape(-1), y.reshape(-1)], axis=1)


class SamModel:
    """A SAM folder, ready to run."""

    def __init__(self, model: ModelFolder) -> None:
        self.model = model
        self.digest = model.digest
        self.encoder = model.network("vision_encoder")
        self.decoder = model.network("prompt_encoder_mask_decoder")
        preprocessing = model.preprocessing
        self.longest_edge = side_px(preprocessing.get("size"), 1024)
        padded = preprocessing.get("pad_size")
        if isinstance(padded, dict) and {"height", "width"} <= padded.keys():
            self.padded_hw = (int(padded["height"]), int(padded["width"]))
        else:
            self.padded_hw = (side_px(padded, self.longest_edge),) * 2
        self.resample = Image.Resampling(preprocessing.get("resample", Image.Resampling.BILINEAR))
        # transformers' defaults if a key is missing: ImageNet statistics, values in 0..1
        self.mean = np.array(preprocessing.get("image_mean", (0.485, 0.456, 0.406)), dtype=np.float32)
        self.std = np.array(preprocessing.get("image_std", (0.229, 0.224, 0.225)), dtype=np.float32)
        self.rescale = np.float32(preprocessing.get("rescale_factor", 1 / 255))

    @staticmethod
    def load(folder: Path) -> "SamModel":
        """Open a model folder.

        Raises:
            ModelError: it is missing, incomplete or not a SAM.
        """
        return SamModel(
            open_model_folder(folder, "sam", fix="set masks.segmenter: graph, which needs no model")
        )

    def prepare(self, image: UInt8[np.ndarray, "H W 3"]) -> tuple[Float32[np.ndarray, "1 3 h w"], Frame]:
        """Resize to the longest edge, normalise, pad with zeros at the right and bottom."""
        original = (image.shape[0], image.shape[1])
        resized = resized_size(original, self.longest_edge)
        if resized != original:
            shrunk = Image.fromarray(image).resize((resized[1], resized[0]), self.resample)
            image = np.asarray(shrunk)
        values = (image.astype(np.float32) * self.rescale - self.mean) / self.std
        padded = np.zeros((1, 3, *self.padded_hw), dtype=np.float32)
        padded[0, :, : resized[0], : resized[1]] = values.transpose(2, 0, 1)
        return padded, Frame(original, resized, self.padded_hw)

    def encode(self, image: UInt8[np.ndarray, "H W 3"]) -> Encoded:
        """Run the vision encoder."""
        pixels, frame = self.prepare(image)
        embeddings, positional = self.encoder(pixel_values=pixels)
        return Encoded(embeddings, positional, frame)

    def prompts_per_call(self, wanted: int, asked: int) -> int:
        """Prompts of one decoder call: the number the network fixes, if any, else at most `asked`."""
        return self.decoder.fixed_axis("input_points", 1) or min(wanted, asked)

    def decode(
        self, encoded: Encoded, points_xy: Float[np.ndarray, "P 2"]
    ) -> tuple[Float32[np.ndarray, "P 3"], Float32[np.ndarray, "P 3 h w"]]:
        """Three masks for each foreground point of the original image (px).

        Returns:
            predicted IoUs and low-resolution logits; heads as in `HEADS`.
        """
        frame = encoded.frame
        scale = np.array(
            [
                frame.resized_hw[1] / frame.original_hw[1],
                frame.resized_hw[0] / frame.original_hw[0],
            ]
        )
        scores, logits = self.decoder(
            input_points=(points_xy * scale)[None, :, None, :],
            input_labels=np.ones((1, len(points_xy), 1)),
            image_embeddings=encoded.embeddings,
            image_positional_embeddings=encoded.positional,
        )
        require_three_heads(self.decoder.path, scores, logits)
        return scores[0], logits[0]


def valid_low_resolution(low_hw: tuple[int, int], frame: Frame) -> tuple[int, int]:
    """Rows and columns of the low-resolution masks that touch the image; the rest is padding."""
    return (
        -(-frame.resized_hw[0] * low_hw[0] // frame.padded_hw[0]),
        -(-frame.resized_hw[1] * low_hw[1] // frame.padded_hw[1]),
    )


def read_logits(
    logits: Float32[np.ndarray, "K h w"], offset: float, frame: Frame
) -> tuple[Int8[np.ndarray, "K h w"], Float32[np.ndarray, " K"], Int32[np.ndarray, "K 4"]]:
    """Round logits, and measure the stability and the box of each mask.

    Stability is the IoU of the masks at logit thresholds +offset and -offset; 0 if the larger one
    is empty. Departs: SAM counts pixels of the full-size mask; we count low-resolution ones, which
    saves the upscaling of masks that are dropped.

    Returns:
        logits in steps of `LOGIT_STEP`, clipped to +-127 steps; stability; box (xyxy, low-resolution
        px, end exclusive) of what is above 0, all 0 if nothing is.
    """
    height, width = valid_low_resolution((logits.shape[1], logits.shape[2]), frame)
    steps = offset / LOGIT_STEP
    rounded, small, large, boxes = quantise_logits(
        np.ascontiguousarray(logits),
        np.float32(1 / LOGIT_STEP),
        math.floor(steps),  # a whole number exceeds another number if it exceeds its floor
        math.floor(-steps),
        height,
        width,
    )
    return rounded, (small / np.maximum(large, 1)).astype(np.float32), boxes


def taps(
    low: int, padded: int, resized: int, original: int
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N T"]]:
    """How each pixel along one axis of the original image is blended from low-resolution pixels.

    Bilinear from `low` to the padded input, cut to the resized image, bilinear to the original size,
    as SamProcessor does; both steps in one.

    Returns:
        first low-resolution pixel of each pixel of the image, and the weights from there on.
    """
    weights = _bilinear(low, padded)[:resized]
    if resized != original:
        weights = _bilinear(resized, original) @ weights
    touched = weights > 0
    first, last = touched.argmax(axis=1), low - 1 - touched[:, ::-1].argmax(axis=1)
    number = int((last - first).max()) + 1
    first = np.minimum(first, low - number)
    return first, np.take_along_axis(weights, first[:, None] + np.arange(number), axis=1).astype(np.float32)


def _bilinear(source: int, target: int) -> Float[np.ndarray, "target source"]:
    """Weights of bilinear resizing along one axis; pixel centres correspond, the border is repeated."""
    at = np.clip((np.arange(target) + 0.5) * source / target - 0.5, 0, source - 1)
    low = np.minimum(at.astype(np.int64), max(0, source - 2))
    weights = np.zeros((target, source))
    rows = np.arange(target)
    weights[rows, low] = 1 - (at - low)
    weights[rows, np.minimum(low + 1, source - 1)] += at - low
    return weights
