"""Relevancy of a network's latents: every pixel of a view is decoded once, and kept short.

Decoded vectors of one view lie near a plane of few directions (some 65 of 128, 105 of 512). Each is kept
as its coordinates there, in 16 bits, with the cosine of its nearest canonical phrase, which is found from the
whole vector. A text then costs as many products a pixel as there are directions; the limit is reading them.

A sample of the pixels finds the directions. Every pixel is then measured: those that lose too much for the
promise (`lost_for_error`), such as a small object that the sample missed, get directions of their own.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int16

from hilsplat.field.autoencoder import Autoencoder
from hilsplat.query.look_up_kernels import projected_relevancy

ERROR = 2e-3
"""Most by which the relevancy of any pixel may err."""

RESIDUAL = 5e-5
"""Root mean square of what decoded vectors lose outside the kept directions."""

SAMPLE = 8192
"""Latents from which directions are found."""

STEPS = 32767
"""Of a coordinate from 0 to 1; rounding errs by 1.5e-5."""

Parts = Callable[[Callable[[slice], None], int], None]
"""Does some work on all parts of so many pixels."""


@dataclass(frozen=True)
class PlacedProjected:
    """Decoded vectors of a view, ready for texts.

    Attributes:
        coordinates: along each direction, in `STEPS`; one row per direction.
        directions: orthonormal rows.
        generic: cosine with the nearest canonical phrase.
    """

    coordinates: Int16[np.ndarray, "R P"]
    directions: Float32[np.ndarray, "R C"]
    generic: Float32[np.ndarray, " P"]

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.coordinates.nbytes + self.directions.nbytes + self.generic.nbytes


class ProjectedLookUp:
    """Relevancy of a network's latents: that of the decoded vectors to `ERROR`, at every pixel."""

    def __init__(self, code: Autoencoder, canonical: Float32[np.ndarray, "K C"], scale: float) -> None:
        self._code, self._canonical, self._scale = code, canonical, np.float32(scale)
        self._may_lose = lost_for_error(scale, code.channels)

    def place(self, latents: Float32[np.ndarray, "P D"], in_parts: Parts) -> PlacedProjected:
        """Decode what no text changes: every pixel once, those that lose too much again.

        Directions of a sample of all pixels lose `RESIDUAL` there. Pixels that lose more than they may are
        missed, and get directions in the same way, at right angles to all before; the other pixels have 0
        along these, so that what they lose stays as it was. Each round takes at least one of the C
        directions there are, so it ends, at the latest when nothing is left to lose.

        Args:
            latents: of pixels.
            in_parts: shares the pixels among threads.
        """
        directions, others = self._directions(latents, np.eye(self._code.channels))
        coordinates, generic, lost = self._decode(latents, directions, in_parts)
        missed = np.flatnonzero(lost > self._may_lose)
        while len(missed) and len(others):
            more, others = self._directions(latents[missed], others)
            directions = np.concatenate([directions, more])
            # Rows of 0 in place: a copy would hold a large view twice.
            coordinates.resize((len(directions), len(latents)), refcheck=False)
            coordinates[:, missed], generic[missed], lost = self._decode(
                latents[missed], directions, in_parts
            )
            missed = missed[lost > self._may_lose]
        return PlacedProjected(coordinates, directions, generic)

    def look_up(
        self,
        placed: PlacedProjected,
        span: slice,
        text: Float32[np.ndarray, " C"],
        out: Float32[np.ndarray, " p"],
    ) -> None:
        """Write the relevancy of a text at the latents of a span."""
        _, weights = self.text_weights(placed.directions, text)
        projected_relevancy(placed.coordinates, placed.generic, span.start, weights, self._scale, out)

    def text_weights(
        self, directions: Float32[np.ndarray, "R C"], text: Float32[np.ndarray, " C"]
    ) -> tuple[np.float32, Float32[np.ndarray, " R"]]:
        """A text's cosine is offset + weights . coordinates."""
        return np.float32(0), (directions @ text / STEPS).astype(np.float32)

    def _directions(
        self, latents: Float32[np.ndarray, "P D"], among: Float64[np.ndarray, "A C"]
    ) -> tuple[Float32[np.ndarray, "R C"], Float64[np.ndarray, "B C"]]:
        """`main_directions` of what a sample decodes to."""
        some = latents[:: max(1, -(-len(latents) // SAMPLE))]
        found, others = main_directions(self._code.decode_array(some), among)
        return found.astype(np.float32), others

    def _decode(
        self, latents: Float32[np.ndarray, "P D"], directions: Float32[np.ndarray, "R C"], in_parts: Parts
    ) -> tuple[Int16[np.ndarray, "R P"], Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
        """Coordinates, cosine with the nearest phrase, and how much each loses outside the directions."""
        coordinates = np.empty((len(directions), len(latents)), np.int16)
        generic, lost = np.empty(len(latents), np.float32), np.empty(len(latents), np.float32)

        def decode(span: slice) -> None:
            vectors = self._code.decode_array(latents[span])
            generic[span] = (vectors @ self._canonical.T).max(axis=1)
            along = directions @ vectors.T
            coordinates[:, span] = np.rint(along * STEPS)
            # 1 less the squares of the coordinates would not do: it is known to 1e-7, the square of 3e-4.
            rest = vectors - along.T @ directions
            lost[span] = np.sqrt(np.einsum("pc,pc->p", rest, rest))

        in_parts(decode, len(latents))
        return coordinates, generic, lost


def lost_for_error(scale: float, channels: int) -> float:
    """How much of a decoded unit vector the directions may lose, so that relevancy errs by at most `ERROR`.

    Relevancy is 1 / (1 + exp(-s (e.q - g))) with a unit text q. The nearest phrase's g is that of the whole
    vector, so that only e.q errs: by at most |q| = 1 times the distance of e from what is kept of it. That
    is what the directions lose, and the rounding of at most C coordinates, sqrt(C) / (2 `STEPS`). The slope
    is s / 4 at most, where text and phrase tie. So the directions may lose

        4 `ERROR` / s - sqrt(C) / (2 `STEPS`),

    4.5e-4 with s = 10 and C = 512. (Loss and rounding are at right angles and make less than their sum,
    which leaves room for sums in 32 bits.)

    Departs: never less than `RESIDUAL`. From s = 20 (C = 512) on, 16 bits do not hold the promise, and
    relevancy errs by up to s / 4 times the sum of `RESIDUAL` and rounding.
    """
    return max(4 * ERROR / scale - channels**0.5 / (2 * STEPS), RESIDUAL)


def main_directions(
    vectors: Float32[np.ndarray, "P C"], among: Float64[np.ndarray, "A C"]
) -> tuple[Float64[np.ndarray, "R C"], Float64[np.ndarray, "B C"]]:
    """As few directions as hold the vectors but for `RESIDUAL`, at least one; and the others (A = R + B).

    Args:
        vectors: only what they have in the span of `among` counts.
        among: orthonormal rows, at least one; all directions lie in their span.
    """
    double = vectors.astype(np.float64)
    squares = among @ (double.T @ double / max(len(vectors), 1)) @ among.T
    values, turns = np.linalg.eigh(squares)
    lost = np.sqrt(np.maximum(np.cumsum(values), 0))  # of the smallest directions
    keep = max(1, int((lost > RESIDUAL).sum()))
    directions = turns.T @ among
    return directions[-keep:], directions[:-keep]
