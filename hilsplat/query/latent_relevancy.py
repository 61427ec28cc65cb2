"""Relevancy of rendered latents without decoding every pixel.

- Linear code (PCA): cosines are computed from the d numbers of a latent without decoding (`linear_look_up`).
- Network: a view is decoded once and stored as coordinates along a few directions (`projected_look_up`).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeAlias

import numpy as np
from jaxtyping import Float32

from hilsplat.field.code import CHUNK_ROWS, Code
from hilsplat.field.linear_code import LinearCode
from hilsplat.query.linear_look_up import LinearLookUp, PlacedLinear
from hilsplat.query.projected_look_up import PlacedProjected, ProjectedLookUp
from hilsplat.query.relevancy import relevancy

PIXELS_AT_A_TIME = 1 << 16

Placed: TypeAlias = PlacedLinear | PlacedProjected


class LatentRelevancy:
    """Relevancy of latents to texts, against fixed canonical phrases.

    Args:
        code: decodes latents.
        canonical: unit vectors of the generic phrases.
        scale: scale of the cosines.
        threads: number of threads; results do not depend on it.
    """

    def __init__(
        self,
        code: Code,
        canonical: Float32[np.ndarray, "K C"],
        scale: float,
        threads: int = 1,
    ) -> None:
        self._code, self._canonical, self._scale, self._threads = code, canonical, scale, threads
        self._look_up: LinearLookUp | ProjectedLookUp = (
            LinearLookUp(code, canonical, scale)
            if isinstance(code, LinearCode)
            else ProjectedLookUp(code, canonical, scale)
        )
        self.is_linear = isinstance(code, LinearCode)
        """Whether `fast` equals `exact` up to rounding."""

    def exact(
        self, latents: Float32[np.ndarray, "P D"], texts: Float32[np.ndarray, "T C"]
    ) -> Float32[np.ndarray, "T P"]:
        """Compute relevancy by decoding every latent."""
        out = np.empty((len(texts), len(latents)), np.float32)

        def decode(span: slice) -> None:
            decoded = self._code.decode_array(np.ascontiguousarray(latents[span], np.float32))
            out[:, span] = relevancy(decoded, texts, self._canonical, self._scale)

        self._decode_in_parts(decode, len(latents))
        return out

    def prepare(self, latents: Float32[np.ndarray, "P D"]) -> Placed:
        """Prepare the latents of a view for look-ups."""
        if isinstance(self._look_up, LinearLookUp):
            return self._look_up.place(latents)
        return self._look_up.place(latents, self._decode_in_parts)

    def fast(
        self,
        placed: Placed,
        texts: Float32[np.ndarray, "T C"],
    ) -> Float32[np.ndarray, "T P"]:
        """Compute relevancy with the look-up for this code (see the module).

        Args:
            placed: the result of `prepare`.
            texts: unit vectors.
        """
        out = np.empty((len(texts), len(placed.generic)), np.float32)

        def answer(span: slice) -> None:
            if isinstance(self._look_up, LinearLookUp):
                assert isinstance(placed, PlacedLinear)  # `prepare` made it
                self._look_up.look_up(placed, span, texts, out[:, span])
            else:
                assert isinstance(placed, PlacedProjected)
                self._look_up.look_up(placed, span, texts, out[:, span])

        if len(texts):
            self._in_parts(answer, len(placed.generic))
        return out

    def _decode_in_parts(self, work: Callable[[slice], None], count: int) -> None:
        """Run work that decodes in parts of as many rows as `decode_array` processes at once."""
        self._in_parts(work, count, CHUNK_ROWS)

    def _in_parts(self, work: Callable[[slice], None], count: int, at_a_time: int = PIXELS_AT_A_TIME) -> None:
        spans = [slice(begin, begin + at_a_time) for begin in range(0, count, at_a_time)]
        if self._threads == 1:
            for span in spans:
                work(span)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(work, spans))
