"""Segment Anything in onnxruntime: three masks per point prompt on an image.

The models are ONNX exports from the transformers library, and images and masks are resized as in the
library's SamProcessor. The rounding of logits (`read_logits`) is ours.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int32, Int64, Real, UInt8
from PIL import Image

from hilsplat.base.errors import ModelError
from hilsplat.base.levels import Level
from hilsplat.base.lineage import sha256_of_bytes
from hilsplat.base.processes import in_order
from hilsplat.models import int8
from hilsplat.models.card import CPU, Batches, in_turn, network_device
from hilsplat.models.folder import SAM_SIDE_PX, ModelFolder, input_side_px, open_model_folder
from hilsplat.models.layouts import DECODER, PREVIEW
from hilsplat.models.memory import card_mib
from hilsplat.models.network import Array, Network, on_host, or_as_exported
from hilsplat.models.onnx_graph import Graph, with_rowwise_attention
from hilsplat.models.repeatable import random_pixels, require_repeatable_once
from hilsplat.segment.decoder_network import DecoderNetwork
from hilsplat.segment.factored_decoder import HEADS_PER_ATTENTION, PROMPTS, FactoredDecoder, ImageTerms
from hilsplat.segment.kernels import areas_and_boxes, upscaled_runs
from hilsplat.segment.thresholds import REAL_SAM, Thresholds, own_thresholds
from hilsplat.settings import MasksSettings

logger = logging.getLogger(__name__)

HEADS: tuple[Level, Level, Level] = (Level.SUBPART, Level.PART, Level.WHOLE)
"""Levels of the decoder's three outputs, in the order of the outputs: fine to coarse."""
LOGIT_STEP = 1 / 8
"""Logits are rounded to this step and clipped to +-127 steps, so that a view's candidates take a few MB in
the cache. Borders move by less than 0.01 low-resolution pixels where the logit changes by 5 per pixel, as is
typical for SAM."""


@dataclass(frozen=True)
class Frame:
    """Position of an image in the network's square input; sizes in px."""

    original_hw: tuple[int, int]
    resized_hw: tuple[int, int]  # size of the image in the input, where it is at the top left
    padded_hw: tuple[int, int]  # size of the whole input
    stretched: bool = False  # the image fills the input, and masks are upscaled in one step (SAM 2)


@dataclass(frozen=True)
class Encoded:
    """Output of the vision encoder for one image."""

    features: Mapping[str, Array]  # inputs of the decoder by name, float32 (1, C, h, w)
    frame: Frame
    terms: ImageTerms | None = None  # arrays of the factored decoder, if the model has one


Prompts = Mapping[str, Array]
"""Prompts of an image, as arrays with one row per prompt: `points` (x, y, px of the image) or, for previewed
prompts, the arrays that the factored decoder keeps."""


MAX_PROMPTS = 256  # per call on a card
CHECKED_PROMPTS, AGREEMENT = 2, 1e-4
"""Number of prompts for checking the factored decoder against the network, and the maximum difference."""


def point_grid(points_per_side: int) -> Float[np.ndarray, "P 2"]:
    """Return the cell centres of a grid on the unit square, as (x, y), row by row."""
    centres = (np.arange(points_per_side) + 0.5) / points_per_side
    x, y = np.meshgrid(centres, centres)
    return np.stack([x.reshape(-1), y.reshape(-1)], axis=1)


class SamModel:
    """A SAM model folder, opened for inference."""

    precision: str = "fp32"  # precision of the encoder: "fp32", "int8" or "fp16"
    own: Thresholds = REAL_SAM
    stretches: bool = False  # images are stretched to a square (SAM 2), not padded (SAM)
    previewer: DecoderNetwork | None = None  # the decoder at half the resolution (`layouts.PREVIEW`)
    factored: FactoredDecoder | None = None  # the much faster decoder, if the graph can be factored
    as_exported: bool = True  # the encoder or decoder runs as exported, which takes more memory
    device: str = CPU  # of the networks; on any other, features and logits are tensors (`models.card`)

    def __init__(self, model: ModelFolder, device: str = CPU) -> None:
        self.model, self.digest, self.device = model, model.digest, device
        self._batches: dict[str, Batches] = {}
        self.own = own_thresholds(model)
        self.stretches = model.layout == "sam2"
        preprocessing = model.preprocessing
        self.longest_edge = preprocessing.get("size", SAM_SIDE_PX)
        self.padded_hw = (input_side_px(model),) * 2
        self.resample = Image.Resampling(preprocessing.get("resample", Image.Resampling.BILINEAR))
        # defaults of transformers for missing keys: ImageNet statistics, values in 0..1
        self.mean = np.array(preprocessing.get("image_mean", (0.485, 0.456, 0.406)), dtype=np.float32)
        self.std = np.array(preprocessing.get("image_std", (0.229, 0.224, 0.225)), dtype=np.float32)
        self.rescale = np.float32(preprocessing.get("rescale_factor", 1 / 255))
        self._graph, self.encoder = self._open_encoder()
        self.decoder = DecoderNetwork(model, DECODER)
        features = self._random_features()
        if PREVIEW in model.networks:
            self.previewer = DecoderNetwork(model, PREVIEW, device)
        else:
            cost = "each prompt takes about 6 times as long"
            self.factored = or_as_exported(model.networks[DECODER], cost, lambda: self._factor(features))
        if self.factored is None and device != CPU:
            self.decoder = DecoderNetwork(model, DECODER, device)
        for decoder in filter(None, (self.decoder, self.previewer)):
            in_turn(device, "masks", partial(decoder.require_repeatable, features, self.padded_hw[0]))
        self.as_exported = device == CPU and (
            self.factored is None or (self._graph is None and not self.stretches)
        )

    def choose_precision(
        self, precision: str, images: Sequence[UInt8[np.ndarray, "H W 3"]], cache: Path, threads: int = 1
    ) -> None:
        """Use a lower precision if `masks.precision` requires it, or if masks of these images agree."""
        form = int8.reduced_precision(precision, self.model, "vision_encoder", self.device)
        if not form:
            return
        reduced = self.int8_encoder(cache) if form == "int8" else self.encoder.in_half()
        if reduced is None:
            return
        grid = point_grid(int8.CHECKED_GRID)
        batch = self.prompts_per_call(self.own.points_per_batch, len(grid))

        def masks(work: tuple[np.ndarray, Network]) -> np.ndarray:
            image, encoder = work
            encoded, points = self.encode(image, encoder), grid * (image.shape[1], image.shape[0])

            def decode(rows: np.ndarray, number: int) -> np.ndarray:
                # without the check of `decode`: an overflow in lower precision only means disagreement
                return on_host(self._decode(encoded, points[rows])[1])[:number]

            logits = np.concatenate(list(self.batches("masks", batch)(len(points), decode)))
            return logits.reshape(-1, *logits.shape[2:]) > 0

        def measure() -> dict[str, float]:
            work = [(image, encoder) for encoder in (self.encoder, reduced) for image in images]
            full, lower = np.split(np.stack(list(in_order(masks, work, threads))), 2)
            return int8.agreement_of_masks(np.concatenate(full), np.concatenate(lower))

        digests = [sha256_of_bytes(image.tobytes()) for image in images]
        inputs = {"model": self.digest, "images": digests, "grid": int8.CHECKED_GRID}
        if int8.use_reduced(form, precision, "SAM's encoder", cache, inputs, measure):
            self.encoder, self.precision = reduced, form

    def int8_encoder(self, cache: Path) -> Network | None:
        """Open the int8 version of the encoder (`models.int8.int8_network`)."""
        exact = [name for name in self.encoder.outputs if name == "image_positional_embeddings"]
        return int8.int8_network(self.model, "vision_encoder", cache, self._graph, exact)

    def _open_encoder(self) -> tuple[Graph | None, Network]:
        """Return the encoder, and its graph if a ViT's global attention is computed row by row on a CPU."""
        vision, path = self.model.config.get("vision_config"), self.model.networks["vision_encoder"]

        def open_as(graph: Graph | None) -> tuple[Graph | None, Network]:
            network = self.model.network("vision_encoder", graph, self.device)
            form = "as exported" if graph is None else "row-wise"
            pixels = random_pixels(network, self.padded_hw[0])
            in_turn(self.device, "masks", lambda: require_repeatable_once(self.model, network, form, pixels))
            return graph, network

        if self.stretches or not isinstance(vision, dict) or self.device != CPU:
            return open_as(None)

        def rowwise() -> tuple[Graph | None, Network]:
            side = vision.get("image_size", 1024) // vision.get("patch_size", 16)
            layers = vision.get("global_attn_indexes", (2, 5, 8, 11))
            return open_as(with_rowwise_attention(path, layers, vision.get("num_attention_heads", 12), side))

        cost = "each image takes about 5 times as much memory"
        return or_as_exported(path, cost, rowwise) or open_as(None)

    def _random_features(self) -> dict[str, np.ndarray]:
        """Return random image features; the encoder runs only if no network declares their shapes."""
        rng = np.random.default_rng(0)
        pair = self.encoder, self.decoder.network
        shapes = {
            name: tuple(max(network.fixed_axis(name, axis) or 0 for network in pair) for axis in (1, 2, 3))
            for name in self.encoder.spec.outputs
        }
        if all(map(all, shapes.values())):
            return {name: rng.standard_normal((1, *shape), np.float32) for name, shape in shapes.items()}
        features = self.encoder(**random_pixels(self.encoder, self.padded_hw[0]))
        return dict(zip(self.encoder.spec.outputs, features, strict=True))

    def _factor(self, features: Mapping[str, np.ndarray]) -> FactoredDecoder:
        """Return the factored decoder; raise an exception if factoring or the comparison fails."""
        config = self.model.config.get("mask_decoder_config", {})
        heads = config.get("num_attention_heads", HEADS_PER_ATTENTION)
        if self.device == CPU:
            factored = FactoredDecoder(self.decoder, heads)
        else:
            from hilsplat.segment.torch_decoder import TorchDecoder  # torch takes seconds to import

            factored = TorchDecoder(self.decoder, heads, self.device)
        difference = largest_difference(factored, self.decoder, features, self.padded_hw[0])
        if not difference <= AGREEMENT:
            raise ModelError(f"the factored decoder differs by {difference:.2g}")
        return factored

    @staticmethod
    def load(folder: Path, variant: str = "", device: Literal["auto", "cpu", "cuda"] = "cpu") -> "SamModel":
        """Open a model folder on the device that a setting selects.

        Errors as in `open_model_folder` and `network_device`.
        """
        fix = "set masks.segmenter: graph, which needs no model"
        model = open_model_folder(folder, "sam", variant=variant, fix=fix)
        return SamModel(model, network_device(device, "masks", card_mib(model)))

    def thresholds(self, settings: MasksSettings) -> Thresholds:
        """Return the settings' thresholds, with the model's own in place of `auto`."""
        chosen = {name: getattr(settings, name) for name in vars(self.own)}
        return replace(self.own, **{name: value for name, value in chosen.items() if value != "auto"})

    def frame(self, original_hw: tuple[int, int]) -> Frame:
        """Return the position of an image of this size in the network's input.

        Sides are rounded to the nearest pixel, halves up, as in SamProcessor. Departs: no side becomes 0.
        """
        if self.stretches:
            return Frame(original_hw, self.padded_hw, self.padded_hw, stretched=True)
        scale = self.longest_edge / max(original_hw)
        height, width = (max(1, int(side * scale + 0.5)) for side in original_hw)
        return Frame(original_hw, (height, width), self.padded_hw)

    def prepare(self, image: UInt8[np.ndarray, "H W 3"]) -> tuple[Float32[np.ndarray, "1 3 h w"], Frame]:
        """Resize and normalise an image, and pad it with zeros at the right and bottom."""
        frame = self.frame((image.shape[0], image.shape[1]))
        height, width = frame.resized_hw
        if frame.resized_hw != frame.original_hw:
            image = np.asarray(Image.fromarray(image).resize((width, height), self.resample))
        values = (image.astype(np.float32) * self.rescale - self.mean) / self.std
        padded = np.zeros((1, 3, *self.padded_hw), dtype=np.float32)
        padded[0, :, :height, :width] = values.transpose(2, 0, 1)
        return padded, frame

    def encode(self, image: UInt8[np.ndarray, "H W 3"], encoder: Network | None = None) -> Encoded:
        """Run the vision encoder, or the version of it given as `encoder`."""
        pixels, frame = self.prepare(image)
        names, network = self.encoder.spec.outputs, encoder or self.encoder

        def run() -> Encoded:
            features = dict(zip(names, network.run(pixel_values=pixels), strict=True))
            return Encoded(features, frame, self.factored.image(features) if self.factored else None)

        return in_turn(self.device, "masks", run)

    def prompts_per_call(self, limit: int, prompts: int) -> int:
        """Return the number of prompts per call: the decoder's fixed number, else min(limit, prompts)."""
        if self.factored:
            return PROMPTS
        return self.decoder.prompts_per_call or min(limit, prompts)

    def batches(self, what: str, size: int) -> Batches:
        """Return the calls for many prompts; on a card, their size is kept for each kind of call."""
        if self.device == CPU:
            return Batches(size, is_padded=True)
        if what not in self._batches:
            most = size if self.decoder.prompts_per_call and not self.factored else MAX_PROMPTS
            self._batches[what] = Batches(size, self.device, most, is_padded=self.factored is None)
        return self._batches[what]

    def decode(
        self, encoded: Encoded, points_xy: Float[np.ndarray, "P 2"]
    ) -> tuple[Float32[np.ndarray, "P 3"], Float32[Array, "P 3 h w"]]:
        """Return predicted IoUs and low-resolution logits (ordered as `HEADS`) for each image point, px."""
        iou, logits = self._decode(encoded, points_xy)
        return self._finite(iou), logits

    def _decode(
        self, encoded: Encoded, points_xy: Float[np.ndarray, "P 2"]
    ) -> tuple[Float32[Array, "P 3"], Float32[Array, "P 3 h w"]]:
        points = in_input(points_xy, encoded.frame)
        if self.factored and encoded.terms:
            return self.factored.decode(encoded.terms, points, fine=True)[:2]
        return self.decoder(encoded.features, points[:, None])

    def _finite(self, iou: Float32[Array, "*n"]) -> Float32[np.ndarray, "*n"]:
        """Return predicted IoUs; raise ModelError if they are not numbers, as otherwise no mask is kept."""
        iou = on_host(iou)
        if not np.isfinite(iou).all():
            precision = "" if self.precision == "fp32" else "set masks.precision: fp32, or "
            raise ModelError(
                f"the SAM model {self.model.folder} predicts {np.count_nonzero(~np.isfinite(iou))} IoUs of "
                f"{iou.size} that are not finite",
                fix=f"{precision}use another variant (masks.variant), or another export of the model",
            )
        return iou

    def decode_clicks(
        self, encoded: Encoded, points_xy: Float[np.ndarray, "K 2"], inside: Bool[np.ndarray, " K"]
    ) -> tuple[Float32[np.ndarray, " 3"], Float32[Array, "3 h w"]]:
        """Decode three masks of one object for several points (px) inside or outside it."""
        points = in_input(points_xy, encoded.frame)[None]
        iou, logits = self.decoder(encoded.features, points, inside[None])
        return self._finite(iou[0]), logits[0]

    @property
    def previews(self) -> bool:
        """Whether the model can also decode prompts at a lower resolution, in less time."""
        return self.previewer is not None or self.factored is not None

    def preview(
        self, encoded: Encoded, points_xy: Float[np.ndarray, "P 2"]
    ) -> tuple[Float32[np.ndarray, "P 3"], Float32[Array, "P 3 low_h low_w"], Prompts]:
        """Decode prompts at a lower resolution (requires `previews`); pass the third result to `finish`."""
        points = in_input(points_xy, encoded.frame)
        if self.factored and encoded.terms:
            iou, logits, prompts = self.factored.decode(encoded.terms, points, fine=False)
            iou = self._finite(iou)
            return iou, logits, {"iou": iou, **prompts}
        assert self.previewer is not None
        iou, logits = self.previewer(encoded.features, points[:, None])
        return self._finite(iou), logits, {"points": points_xy}

    def finish(
        self, encoded: Encoded, prompts: Prompts
    ) -> tuple[Float32[np.ndarray, "P 3"], Float32[Array, "P 3 h w"]]:
        """Decode prompts that may have been previewed, at full resolution."""
        if "points" in prompts:
            return self.decode(encoded, prompts["points"])
        assert self.factored and encoded.terms
        return prompts["iou"], self.factored.logits(encoded.terms, prompts)


def in_input(points_xy: Float[np.ndarray, "P 2"], frame: Frame) -> Float[np.ndarray, "P 2"]:
    """Convert points of an image to points of the network's input, px."""
    (height, width), (resized_h, resized_w) = frame.original_hw, frame.resized_hw
    return points_xy * np.array([resized_w / width, resized_h / height])


def enlarged(logits: Float32[np.ndarray, "K h w"], frame: Frame) -> Bool[np.ndarray, "K H W"]:
    """Upscale low-resolution logits as SamProcessor does, and return the masks at the image's size."""
    masks = []
    for values in logits:
        if not frame.stretched:
            values = cv2.resize(values, frame.padded_hw[::-1], interpolation=cv2.INTER_LINEAR)
            values = values[: frame.resized_hw[0], : frame.resized_hw[1]]
        masks.append(cv2.resize(values, frame.original_hw[::-1], interpolation=cv2.INTER_LINEAR) > 0)
    return np.stack(masks)


def largest_difference(
    factored: FactoredDecoder, decoder: DecoderNetwork, features: Mapping[str, np.ndarray], side_px: int
) -> float:
    """Return the largest difference between the factored decoder and the network for random points.

    The comparison covers predicted IoUs, and logits divided by the largest logit (at least 1).
    """
    points = np.random.default_rng(0).uniform(0, side_px, (CHECKED_PROMPTS, 1, 2))
    step = decoder.prompts_per_call or CHECKED_PROMPTS
    calls = [decoder(features, points[start : start + step]) for start in range(0, CHECKED_PROMPTS, step)]
    iou, logits = map(np.concatenate, zip(*calls, strict=True))
    decoded = factored.decode(factored.image(features), points[:, 0], fine=True)
    fast_iou, fast_logits = map(on_host, decoded[:2])
    difference = np.abs(fast_logits - logits).max() / max(1, np.abs(logits).max())
    return float(max(difference, np.abs(fast_iou - iou).max()))


def read_logits(
    logits: Float32[Array, "K h w"], offset: float, frame: Frame
) -> tuple[Int8[Array, "K h w"], Float32[np.ndarray, " K"], Int32[np.ndarray, "K 4"]]:
    """Round logits, and compute the stability and the box of each mask.

    Stability is the IoU of the masks at logit thresholds +offset and -offset, or 0 if the larger one
    is empty. Departs: SAM counts pixels of the full-size mask (`full_stability`); we count low-resolution
    ones, so that dropped masks need no upscaling.

    Returns:
        logits in steps of `LOGIT_STEP`, clipped to +-127 steps, where the given logits are; stability; box
        (xyxy, low-resolution px, end exclusive) of the positive logits, all 0 if there are none.
    """
    # low-resolution rows and columns that overlap the image; the rest is padding
    height, width = (
        -(-frame.resized_hw[axis] * logits.shape[1 + axis] // frame.padded_hw[axis]) for axis in (0, 1)
    )
    # an integer exceeds x if and only if it exceeds floor(x)
    upper, lower = math.floor(offset / LOGIT_STEP), math.floor(-offset / LOGIT_STEP)
    if not isinstance(logits, np.ndarray):
        from hilsplat.segment import torch_decoder

        on_card, areas = torch_decoder.steps_and_areas(logits, LOGIT_STEP, (upper, lower), (height, width))
        return on_card, (areas[0] / np.maximum(areas[1], 1)).astype(np.float32), positive_boxes(on_card)
    steps, stability = np.empty(logits.shape, np.int8), np.empty(len(logits), np.float32)
    for row, values in enumerate(logits):  # one by one, in the processor's cache
        steps[row] = np.rint(values / np.float32(LOGIT_STEP)).clip(-127, 127)
        visible = steps[row, :height, :width]
        stability[row] = np.count_nonzero(visible > upper) / max(1, int(np.count_nonzero(visible > lower)))
    return steps, stability, positive_boxes(steps)


def positive_boxes(logits: Real[Array, "K h w"]) -> Int32[np.ndarray, "K 4"]:
    """Return the box (xyxy, end exclusive) of the positive logits of each mask, all 0 if there are none."""
    if not isinstance(logits, np.ndarray):
        from hilsplat.segment import torch_decoder

        return torch_decoder.positive_boxes(logits)
    boxes = np.empty((len(logits), 4), np.int32)
    for row, values in enumerate(logits):
        x, y, width, height = cv2.boundingRect((values > 0).view(np.uint8))
        boxes[row] = x, y, x + width, y + height
    return boxes


def full_stability(
    logits: Float32[np.ndarray, "K h w"], offset: float, frame: Frame
) -> Float32[np.ndarray, " K"]:
    """Compute the stability at the image's size from unrounded logits, as in SAM."""
    number, height, width = logits.shape
    areas = []
    for threshold in (offset, -offset):
        runs, offsets = upscaled_runs(
            (logits - np.float32(threshold)).reshape(-1),
            np.arange(number + 1) * (height * width),
            np.tile(np.array([0, 0, width, height], np.int32), (number, 1)),
            np.arange(number),
            *frame_taps((height, width), frame),
            0,
            0,
            *frame.original_hw,
        )
        areas.append(areas_and_boxes(runs, offsets, frame.original_hw[1])[0])
    return (areas[0] / np.maximum(areas[1], 1)).astype(np.float32)


def frame_taps(low_hw: tuple[int, int], frame: Frame) -> tuple[np.ndarray, ...]:
    """Return the taps (`taps`) that map low-resolution rows, then columns, to image rows and columns."""
    padded, resized = (low_hw, low_hw) if frame.stretched else (frame.padded_hw, frame.resized_hw)
    along_y, along_x = map(taps, low_hw, padded, resized, frame.original_hw)
    return *along_y, *along_x


@lru_cache(maxsize=16)
def taps(
    low: int, padded: int, resized: int, original: int
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N T"]]:
    """Return the first low-resolution pixel that each pixel along an axis reads, and the weights from there.

    The weights combine SamProcessor's steps: bilinear from `low` to the padded input, cropping to the resized
    image, bilinear to the original size.
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
    """Return the weights of bilinear resizing along one axis; pixel centres align, the border is repeated."""
    at = np.clip((np.arange(target) + 0.5) * source / target - 0.5, 0, source - 1)
    low = np.minimum(at.astype(np.int64), max(0, source - 2))
    weights = np.zeros((target, source))
    rows = np.arange(target)
    weights[rows, low] = 1 - (at - low)
    weights[rows, np.minimum(low + 1, source - 1)] += at - low
    return weights
