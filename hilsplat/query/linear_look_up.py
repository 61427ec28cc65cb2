"""Relevancy of the latents of a linear code, without decoding them.

The length of a decoded latent and its nearest canonical phrase do not depend on the text, so they are found
once per view. A text then costs d products per pixel. Latents are stored channel by channel, which lets the
compiler process eight or sixteen pixels at once. Memory bandwidth is the limit: three levels of a 986 x 728
view at d = 16 are 138 MB.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from hilsplat.field.linear_code import LinearCode
from hilsplat.query.look_up_kernels import by_channel, lengths_and_generic, linear_relevancy


@dataclass(frozen=True)
class PlacedLinear:
    """Latents of a view, prepared for look-ups.

    Attributes:
        channels: latents, one row per channel.
        length: length of each decoded vector before normalisation.
        generic: cosine with the nearest canonical phrase.
    """

    channels: Float32[np.ndarray, "D P"]
    length: Float32[np.ndarray, " P"]
    generic: Float32[np.ndarray, " P"]

    @property
    def nbytes(self) -> int:
        """Memory used, bytes."""
        return self.channels.nbytes + self.length.nbytes + self.generic.nbytes


class LinearLookUp:
    """Relevancy of a linear code's latents, equal to that of the decoded vectors up to rounding."""

    def __init__(self, code: LinearCode, canonical: Float32[np.ndarray, "K C"], scale: float) -> None:
        self._code, self._scale = code, np.float32(scale)
        self._offsets, self._slopes, self._mean_square, self._cross = code.cosine_terms(canonical)

    def place(self, latents: Float32[np.ndarray, "P D"]) -> PlacedLinear:
        """Compute everything that does not depend on the text."""
        channels = by_channel(latents)
        length, generic = (np.empty(len(latents), np.float32) for _ in range(2))
        lengths_and_generic(
            channels,
            self._cross,
            np.float32(self._mean_square),
            self._offsets,
            self._slopes,
            length,
            generic,
        )
        return PlacedLinear(channels, length, generic)

    def look_up(
        self,
        placed: PlacedLinear,
        span: slice,
        texts: Float32[np.ndarray, "T C"],
        out: Float32[np.ndarray, "T p"],
    ) -> None:
        """Write the relevancy of texts for a span of latents."""
        weights = [self.text_weights(text) for text in texts]
        linear_relevancy(
            placed.channels,
            placed.length,
            placed.generic,
            span.start,
            np.array([offset for offset, _ in weights], np.float32),
            np.array([slope for _, slope in weights], np.float32),
            self._scale,
            out,
        )

    def text_weights(self, text: Float32[np.ndarray, " C"]) -> tuple[np.float32, Float32[np.ndarray, " D"]]:
        """Return a text's offset and weights; its cosine is (offset + weights . channels) / length."""
        offsets, slopes, _, _ = self._code.cosine_terms(text[None])
        return offsets[0], slopes[0]
