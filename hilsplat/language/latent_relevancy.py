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
from hilsplat.language.linear_look_up import LinearLookUp, PlacedLinear
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
        self._linear: LinearLookUp | None = None
        if isinstance(code, LinearCode):
            self._linear = LinearLookUp(code, canonical, scale)
        elif isinstance(code, Autoencoder) and code.latent == 3:
            self.grid = LatentGrid(code, features, canonical, scale)

    @property
    def is_linear(self) -> bool:
        """Whether the fast way loses nothing but rounding."""
        return self._linear is not None

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

    def prepare(self, latents: Float32[np.ndarray, "P D"]) -> Placed | PlacedLinear | None:
        """What a look-up of these latents needs; once per view. None where every latent is decoded."""
        if self._linear is not None:
            return self._linear.place(latents)
        return None if self.grid is None else self.grid.place(latents)

    def fast(
        self,
        latents: Float32[np.ndarray, "P D"],
        placed: Placed | PlacedLinear | None,
        texts: Float32[np.ndarray, "T C"],
    ) -> Float32[np.ndarray, "T P"]:
        """The fast way of this code; see the module for which that is.

        Args:
            latents: of pixels.
            placed: what `prepare` returned for them.
            texts: unit vectors.
        """
        if placed is None:
            return self.exact(latents, texts)
        out = np.empty((len(texts), len(latents)), np.float32)
        for text, row in zip(texts, out, strict=True):
            self._in_parts(self._look_up(placed, text, row), len(latents))
        return out

    def _look_up(
        self,
        placed: Placed | PlacedLinear,
        text: Float32[np.ndarray, " C"],
        out: Float32[np.ndarray, " P"],
    ) -> Callable[[slice], None]:
        if isinstance(placed, PlacedLinear):
            linear = self._linear
            return lambda span: linear.look_up(placed, span, text, out[span])
        grid, table = self.grid, self.grid.table(text)
        return lambda span: grid.look_up(table, placed.cell[span], placed.inside[span], out[span])

    def _in_parts(self, work: Callable[[slice], None], count: int, at_a_time: int = PIXELS_AT_A_TIME) -> None:
        spans = [slice(begin, begin + at_a_time) for begin in range(0, count, at_a_time)]
        if self._threads == 1:
            for span in spans:
                work(span)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            list(pool.map(work, spans))
