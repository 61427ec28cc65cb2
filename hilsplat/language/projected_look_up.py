"""Relevancy of a network's latents: every pixel of a view is decoded once, and kept short.

Decoded vectors of one view lie near a plane of few directions (some 65 of 128, 105 of 512). Each is kept
as its coordinates there, in 16 bits, with the cosine of its nearest canonical phrase, which is found from the
whole vector. A text then costs as many products a pixel as there are directions; the limit is reading them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16

from hilsplat.language.autoencoder import Autoencoder
from hilsplat.language.look_up_kernels import projected_relevancy

RESIDUAL = 5e-5
"""Root mean square of what decoded vectors lose outside the kept directions."""

SAMPLE = 8192
"""Latents from which the directions are found."""

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
    """Relevancy of a network's latents, that of the decoded vectors to 2e-3 (tested)."""

    def __init__(self, code: Autoencoder, canonical: Float32[np.ndarray, "K C"], scale: float) -> None:
        self._code, self._canonical, self._scale = code, canonical, np.float32(scale)

    def place(self, latents: Float32[np.ndarray, "P D"], in_parts: Parts) -> PlacedProjected:
        """Decode once what no text changes.

        Args:
            latents: of pixels.
            in_parts: shares the pixels among threads.
        """
        directions = self._directions(latents)
        coordinates = np.empty((len(directions), len(latents)), np.int16)
        generic = np.empty(len(latents), np.float32)

        def decode(span: slice) -> None:
            vectors = self._code.decode_array(np.ascontiguousarray(latents[span], np.float32))
            generic[span] = (vectors @ self._canonical.T).max(axis=1)
            coordinates[:, span] = np.rint(directions @ vectors.T * STEPS)

        in_parts(decode, len(latents))
        return PlacedProjected(coordinates, directions, generic)

    def look_up(
        self,
        placed: PlacedProjected,
        span: slice,
        text: Float32[np.ndarray, " C"],
        out: Float32[np.ndarray, " p"],
    ) -> None:
        """Write the relevancy of a text at the latents of a span."""
        weights = (placed.directions @ text / STEPS).astype(np.float32)
        projected_relevancy(placed.coordinates, placed.generic, span.start, weights, self._scale, out)

    def _directions(self, latents: Float32[np.ndarray, "P D"]) -> Float32[np.ndarray, "R C"]:
        """As few as hold the decoded vectors but for `RESIDUAL`, at least one."""
        some = latents[:: max(1, -(-len(latents) // SAMPLE))]
        vectors = self._code.decode_array(np.ascontiguousarray(some, np.float32)).astype(np.float64)
        squares = np.einsum("nc,nd->cd", vectors, vectors) / max(len(vectors), 1)
        values, directions = np.linalg.eigh(squares)
        lost = np.sqrt(np.maximum(np.cumsum(values), 0))  # of the smallest directions
        keep = max(1, int((lost > RESIDUAL).sum()))
        return np.ascontiguousarray(directions[:, -keep:].T, np.float32)
