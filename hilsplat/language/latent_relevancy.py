"""Relevancy of rendered latents without decoding every pixel.

- d = 3: the decoder becomes a table of cells (see `latent_grid`). A text costs one product with the
  corners of the cells, a pixel one trilinear look-up.
- a linear code (PCA), any d: cosines are ratios of d numbers and need no decoding at all.
- a network of another size: every latent is decoded, in chunks.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from jaxtyping import Float32

from hilsplat.language.autoencoder import CHUNK_ROWS, Autoencoder, Code, one_torch_thread
from hilsplat.language.latent_grid import LatentGrid, Placed
from hilsplat.language.linear_code import LinearCode
from hilsplat.language.quadratic import compiled
from hilsplat.language.relevancy import relevancy

PIXELS_AT_A_TIME = 1 << 16


class LatentRelevancy:
    """Relevancy of latents to texts, against fixed canonical phrases.

    Args:
        code: decodes latents.
        canonical: unit vectors of the generic phrases.
        scale: of the cosines.
        features: latents of the Gaussians.
        threads: pixels are shared among them; results do not depend on it.
    """

    def __init__(
        self,
        code: Code,
        canonical: Float32[np.ndarray, "K C"],
        scale: float,
        features: Float32[np.ndarray, "N D"],
        threads: int = 1,
    ) -> None:
        self._code, self._canonical, self._scale, self._threads = code, canonical, scale, threads
        self.grid: LatentGrid | None = None
        if isinstance(code, Autoencoder) and code.latent == 3:
            self.grid = LatentGrid(code, features, canonical, scale)

    def exact(
        self, latents: Float32[np.ndarray, "P D"], texts: Float32[np.ndarray, "T C"]
    ) -> Float32[np.ndarray, "T P"]:
        """By decoding every latent."""
        out = np.empty((len(texts), len(latents)), np.float32)

        def decode(span: slice) -> None:
            torch.set_num_threads(1)  # holds for one thread of the pool; they share the cores already
            decoded = self._code.decode_array(np.ascontiguousarray(latents[span], np.float32))
            out[:, span] = relevancy(decoded, texts, self._canonical, self._scale)

        with one_torch_thread():
            self._in_parts(decode, len(latents), CHUNK_ROWS)
        return out

    def prepare(self, latents: Float32[np.ndarray, "P D"]) -> Placed | None:
        """What a look-up of these latents needs; once per view. None where nothing is looked up."""
        return None if self.grid is None else self.grid.place(latents)

    def fast(
        self, latents: Float32[np.ndarray, "P D"], placed: Placed | None, texts: Float32[np.ndarray, "T C"]
    ) -> Float32[np.ndarray, "T P"]:
        """The fast way of this code; see the module for which that is.

        Args:
            latents: of pixels.
            placed: what `prepare` returned for them.
            texts: unit vectors.
        """
        if isinstance(self._code, LinearCode):
            return self._linear(latents, texts)
        if self.grid is None or placed is None:
            return self.exact(latents, texts)
        out = np.empty((len(texts), len(latents)), np.float32)
        for row, text in enumerate(texts):
            table = self.grid.table(text)
            self._in_parts(
                lambda span, row=row, table=table: self.grid.look_up(
                    table, placed.cell[span], placed.inside[span], out[row, span]
                ),
                len(latents),
            )
        return out

    def _linear(self, latents: np.ndarray, texts: np.ndarray) -> Float32[np.ndarray, "T P"]:
        vectors = np.concatenate([self._canonical, texts])
        offsets, slopes, mean_square, cross = self._code.cosine_terms(vectors)
        out = np.empty((len(texts), len(latents)), np.float32)
        self._in_parts(
            lambda span: _linear_relevancy(
                latents[span],
                offsets,
                slopes,
                np.float32(mean_square),
                cross,
                len(self._canonical),
                np.float32(self._scale),
                out[:, span],
            ),
            len(latents),
        )
        return out

    def _in_parts(self, work: Callable[[slice], None], count: int, at_a_time: int = PIXELS_AT_A_TIME) -> None:
        spans = [slice(begin, begin + at_a_time) for begin in range(0, count, at_a_time)]
        if self._threads == 1:
            for span in spans:
                work(span)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(work, spans))


@compiled
def _linear_relevancy(latents, offsets, slopes, mean_square, cross, num_canonical, scale, out):
    """Cosine of m + U z with each vector, then the relevancy; `slopes` (vectors, D)."""
    num, channels = len(offsets), latents.shape[1]
    dots = np.empty(num, np.float32)
    for p in range(len(latents)):
        square = mean_square
        for c in range(channels):
            square += latents[p, c] * (np.float32(2) * cross[c] + latents[p, c])
        length = np.sqrt(max(square, np.float32(1e-20)))
        for v in range(num):
            dot = offsets[v]
            for c in range(channels):
                dot += slopes[v, c] * latents[p, c]
            dots[v] = dot / length
        generic = dots[0]
        for v in range(1, num_canonical):
            generic = max(generic, dots[v])
        for t in range(len(out)):
            out[t, p] = np.float32(1) / (np.float32(1) + np.exp(-scale * (dots[num_canonical + t] - generic)))
