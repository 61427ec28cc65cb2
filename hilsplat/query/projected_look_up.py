"""Relevancy of a network's latents: every pixel of a view is decoded once and stored in compressed form.

The decoded vectors of one view are close to a subspace of few directions (about 65 of 128, 105 of 512). Each
is stored as its coordinates there, in 16 bits, with the cosine of its nearest canonical phrase, computed from
the full vector. A text then costs one product per pixel and direction; memory bandwidth is the limit.

The directions are computed from a sample of the pixels. Every pixel is then checked: pixels that lose too
much for the error bound (`lost_for_error`), such as a small unsampled object, get additional directions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int16

from hilsplat.field.code import Code
from hilsplat.query.look_up_kernels import projected_relevancy

ERROR = 2e-3
"""Maximum error of the relevancy of any pixel."""

RESIDUAL = 5e-5
"""Root mean square of the decoded vectors' component outside the stored directions."""

SAMPLE = 8192
"""Number of latents in the sample from which the directions are computed."""

STEPS = 32767
"""Steps of a coordinate from 0 to 1; the rounding error is at most 1.5e-5."""

Parts = Callable[[Callable[[slice], None], int], None]
"""Function that splits a number of pixels into parts and runs work on each."""


@dataclass(frozen=True)
class PlacedProjected:
    """Decoded vectors of a view, prepared for look-ups.

    Attributes:
        coordinates: along each direction, in units of 1 / `STEPS`; one row per direction.
        directions: orthonormal rows.
        generic: cosine with the nearest canonical phrase.
    """

    coordinates: Int16[np.ndarray, "R P"]
    directions: Float32[np.ndarray, "R C"]
    generic: Float32[np.ndarray, " P"]

    @property
    def nbytes(self) -> int:
        """Memory used, bytes."""
        return self.coordinates.nbytes + self.directions.nbytes + self.generic.nbytes


class ProjectedLookUp:
    """Relevancy of a network's latents, within `ERROR` of the decoded vectors' relevancy at every pixel."""

    def __init__(self, code: Code, canonical: Float32[np.ndarray, "K C"], scale: float) -> None:
        self._code, self._canonical, self._scale = code, canonical, np.float32(scale)
        self._may_lose = lost_for_error(scale, code.channels)

    def place(self, latents: Float32[np.ndarray, "P D"], in_parts: Parts) -> PlacedProjected:
        """Compute everything that does not depend on the text, and decode pixels that lose too much again.

        The directions computed from a sample lose `RESIDUAL` on that sample. Pixels whose loss exceeds the
        limit get additional directions in the same way, orthogonal to all previous ones. The other pixels
        have 0 along these, so their loss does not change. Each round uses at least one of the C directions,
        so the loop ends.

        Args:
            latents: latents of pixels.
            in_parts: distributes the pixels among threads.
        """
        directions, others = self._directions(latents, np.eye(self._code.channels))
        coordinates, generic, lost = self._decode(latents, directions, in_parts)
        missed = np.flatnonzero(lost > self._may_lose)
        while len(missed) and len(others):
            more, others = self._directions(latents[missed], others)
            directions = np.concatenate([directions, more])
            # Rows of 0 are added in place; a copy would store a large view twice.
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
        texts: Float32[np.ndarray, "T C"],
        out: Float32[np.ndarray, "T p"],
    ) -> None:
        """Write the relevancy of texts for a span of latents."""
        weights = np.stack([self.text_weights(placed.directions, text)[1] for text in texts])
        projected_relevancy(placed.coordinates, placed.generic, span.start, weights, self._scale, out)

    def text_weights(
        self, directions: Float32[np.ndarray, "R C"], text: Float32[np.ndarray, " C"]
    ) -> tuple[np.float32, Float32[np.ndarray, " R"]]:
        """Return a text's offset and weights; its cosine is offset + weights . coordinates."""
        return np.float32(0), (directions @ text / STEPS).astype(np.float32)

    def _directions(
        self, latents: Float32[np.ndarray, "P D"], among: Float64[np.ndarray, "A C"]
    ) -> tuple[Float32[np.ndarray, "R C"], Float64[np.ndarray, "B C"]]:
        """Return the `main_directions` of a decoded sample."""
        some = latents[:: max(1, -(-len(latents) // SAMPLE))]
        found, others = main_directions(self._code.decode_array(some), among)
        return found.astype(np.float32), others

    def _decode(
        self, latents: Float32[np.ndarray, "P D"], directions: Float32[np.ndarray, "R C"], in_parts: Parts
    ) -> tuple[Int16[np.ndarray, "R P"], Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
        """Return coordinates, cosine with the nearest phrase, and loss outside the directions per pixel."""
        coordinates = np.empty((len(directions), len(latents)), np.int16)
        generic, lost = np.empty(len(latents), np.float32), np.empty(len(latents), np.float32)

        def decode(span: slice) -> None:
            vectors = self._code.decode_array(latents[span])
            generic[span] = (vectors @ self._canonical.T).max(axis=1)
            along = directions @ vectors.T
            coordinates[:, span] = np.rint(along * STEPS)
            # 1 minus the squared coordinates is too inexact: its error of 1e-7 is the square of 3e-4.
            rest = vectors - along.T @ directions
            lost[span] = np.sqrt(np.einsum("pc,pc->p", rest, rest))

        in_parts(decode, len(latents))
        return coordinates, generic, lost


def lost_for_error(scale: float, channels: int) -> float:
    """Return how much of a decoded unit vector the directions may lose for a relevancy error of `ERROR`.

    Relevancy is 1 / (1 + exp(-s (e.q - g))) with a unit text q. The nearest phrase's g is computed from the
    full vector, so only e.q has an error: at most |q| = 1 times the distance of e from its stored form. This
    distance is the loss outside the directions plus the rounding of at most C coordinates,
    sqrt(C) / (2 `STEPS`). The slope is at most s / 4, where text and phrase tie. So the directions may lose

        4 `ERROR` / s - sqrt(C) / (2 `STEPS`),

    which is 4.5e-4 with s = 10 and C = 512. (Loss and rounding are orthogonal, so their combined length is
    less than their sum, which leaves a margin for 32-bit sums.)

    Departs: never less than `RESIDUAL`. At s >= 20 (C = 512), 16 bits are too few for `ERROR`, and relevancy
    has an error of up to s / 4 times the sum of `RESIDUAL` and rounding.
    """
    return max(4 * ERROR / scale - channels**0.5 / (2 * STEPS), RESIDUAL)


def main_directions(
    vectors: Float32[np.ndarray, "P C"], among: Float64[np.ndarray, "A C"]
) -> tuple[Float64[np.ndarray, "R C"], Float64[np.ndarray, "B C"]]:
    """Return the fewest directions (at least one) that lose at most `RESIDUAL`, and the others (A = R + B).

    Args:
        vectors: only their components in the span of `among` are used.
        among: orthonormal rows, at least one; all directions are in their span.
    """
    double = vectors.astype(np.float64)
    squares = among @ (double.T @ double / max(len(vectors), 1)) @ among.T
    values, turns = np.linalg.eigh(squares)
    lost = np.sqrt(np.maximum(np.cumsum(values), 0))  # of the smallest directions
    keep = max(1, int((lost > RESIDUAL).sum()))
    directions = turns.T @ among
    return directions[-keep:], directions[:-keep]
