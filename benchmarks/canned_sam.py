"""A SAM whose network is replaced by a table of blobs, for timings without the network."""

import time

import numpy as np
from PIL import Image

from hilsplat.models.network import Network
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.sam import Encoded, SamModel

LOW_PX = 256
# number and mean radius (low-resolution px) of the blobs of each head: subpart, part, whole
REGIONS = ((260, 9.0), (80, 19.0), (25, 38.0))


class NetworkClock:
    """Timer for pytest-benchmark: processor time without that of the network."""

    def __init__(self) -> None:
        self.network_s = 0.0

    def __call__(self) -> float:
        return time.process_time() - self.network_s


def blob_logits(
    centres_xy: np.ndarray, radii: np.ndarray, size_hw: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    """Return logits of wobbly discs, float32 (K, h, w), with SAM's slope at the border, 5 per pixel."""
    y, x = np.mgrid[: size_hw[0], : size_hw[1]].astype(np.float32)
    out = np.empty((len(radii), *size_hw), np.float32)
    for row, ((cx, cy), radius) in enumerate(zip(centres_xy, radii, strict=True)):
        angle = np.arctan2(y - cy, x - cx)
        phases = rng.uniform(0, 2 * np.pi, 3)
        wobble = sum(np.sin((2 + k) * angle + phase) / (2 + k) for k, phase in enumerate(phases))
        out[row] = 5 * (radius * (1 + 0.3 * wobble) - np.hypot(x - cx, y - cy))
    return out


def blob_masks(number: int, size_hw: tuple[int, int], seed: int = 0) -> HierarchicalMasks:
    """Return wobbly discs of log-normal size at one level, about 15 of which cover each pixel."""
    rng = np.random.default_rng(seed)
    height, width = size_hw
    centres = rng.uniform(0, 1, (number, 2)) * (width, height)
    radii = np.minimum(0.03 * width * np.exp(0.6 * rng.normal(size=number)), 0.4 * height)
    scores = rng.uniform(0.5, 1, (2, number)).astype(np.float32)
    parts = []
    for row in range(number):
        one = slice(row, row + 1)
        dense = blob_logits(centres[one], radii[one], size_hw, rng) > 0
        parts.append(
            HierarchicalMasks.from_dense(dense, np.ones(1, np.uint8), scores[0, one], scores[1, one])
        )
    return HierarchicalMasks.concatenate(parts)


class CannedSam(SamModel):
    """SAM that returns the nearest blob of each head, slightly larger or smaller for each prompt."""

    def __init__(self, clock: NetworkClock, seed: int = 0) -> None:
        self.clock = clock
        self.longest_edge, self.padded_hw = 1024, (1024, 1024)
        self.resample = Image.Resampling.BILINEAR
        self.mean = np.array((0.485, 0.456, 0.406), np.float32)
        self.std = np.array((0.229, 0.224, 0.225), np.float32)
        self.rescale = np.float32(1 / 255)
        rng = np.random.default_rng(seed)
        self.heads = []
        for number, radius in REGIONS:
            centres = rng.uniform(0, LOW_PX, (number, 2)) * (1, 0.75)  # images of 4 : 3
            radii = radius * np.exp(0.25 * rng.normal(size=number))
            self.heads.append((centres, blob_logits(centres, radii, (LOW_PX, LOW_PX), rng)))

    def prompts_per_call(self, limit: int, prompts: int) -> int:
        """Return the number of prompts, at most the limit."""
        return min(limit, prompts)

    def encode(self, image: np.ndarray, encoder: Network | None = None) -> Encoded:
        """Prepare the image without encoding it."""
        _, frame = self.prepare(image)
        return Encoded({}, frame)

    def decode(self, encoded: Encoded, points_xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return scores and logits of the blobs nearest to each point; the clock excludes this time."""
        start = time.process_time()
        scale = encoded.frame.resized_hw[0] / encoded.frame.original_hw[0] * LOW_PX / self.padded_hw[0]
        low = points_xy * scale
        logits = np.empty((len(low), 3, LOW_PX, LOW_PX), np.float32)
        for head, (centres, table) in enumerate(self.heads):
            nearest = np.linalg.norm(centres[None] - low[:, None], axis=2).argmin(axis=1)
            logits[:, head] = table[nearest]
        wave = np.sin(points_xy.sum(axis=1)).astype(np.float32)
        logits += 2 * wave[:, None, None, None]
        scores = np.repeat(0.95 - 0.02 * wave[:, None] ** 2, 3, axis=1).astype(np.float32)
        self.clock.network_s += time.process_time() - start
        return scores, logits
