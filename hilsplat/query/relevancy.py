"""Similarity of embeddings and texts: cosine margins, and LERF's relevancy, computed from these margins.

`LatentRelevancy` computes relevancy for every pixel of a view from its rendered latents. A linear code needs
no decoding (docs/field.md): latents are stored channel by channel, so that the compiler can process eight or
sixteen pixels at once. Memory bandwidth is the bottleneck: three levels of a 986 x 728 view at d = 16 take
138 MB.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from cpusplat.threads import over_edges
from hilsplat.base.errors import SettingsError
from hilsplat.field.code import CHUNK_ROWS, Code, LinearCode
from hilsplat.query.relevancy_kernels import lengths_and_generic, texts_relevancy

ROWS_AT_A_TIME = 1 << 16
"""Number of embeddings or pixels processed at once; it limits the size of products with many texts."""


def margins(
    embeddings: Float[np.ndarray, "B C"], texts: Float[np.ndarray, "T C"], canonical: Float[np.ndarray, "K C"]
) -> Float32[np.ndarray, "T B"]:
    """Return the cosine with each text minus the cosine with the nearest canonical phrase, in [-2, 2].

    At margin 0, an embedding is as close to the text as to the nearest canonical phrase. Embeddings are
    compared by margins because relevancies saturate. All vectors have unit length.
    """
    out = np.empty((len(texts), len(embeddings)), np.float32)
    vectors = np.concatenate([texts, canonical])  # one product takes less time than two
    for start in range(0, len(embeddings), ROWS_AT_A_TIME):
        cosines = vectors @ embeddings[start : start + ROWS_AT_A_TIME].T
        generic = cosines[len(texts) :].max(axis=0)
        out[:, start : start + ROWS_AT_A_TIME] = cosines[: len(texts)] - generic
    return out


def relevancy_of_margins(margin: Float[np.ndarray, "*n"], scale: float) -> Float[np.ndarray, "*n"]:
    """Return the score used for display and evaluation: 1 / (1 + exp(-scale * margin)), 0.5 at margin 0."""
    return 1 / (1 + np.exp(-scale * margin))


def margin_of_relevancy(score: float, scale: float) -> float:
    """Return the margin with a given score: the inverse of `relevancy_of_margins`.

    Raises:
        SettingsError: the score is not between 0 and 1.
    """
    if not 0 < score < 1:
        raise SettingsError(f"threshold {score:g} is out of range", expected="between 0 and 1")
    return float(np.log(score / (1 - score)) / scale)


def relevancy(
    embeddings: Float[np.ndarray, "B C"],
    texts: Float[np.ndarray, "T C"],
    canonical: Float[np.ndarray, "K C"],
    scale: float = 10.0,
) -> Float32[np.ndarray, "T B"]:
    """Return each text's lowest softmax score against any canonical phrase, in (0, 1).

    rel = min over k of exp(s e.q) / (exp(s e.q) + exp(s e.c_k)), the logistic function of the scaled margin.

    Source: LERF; LangSplat, `eval/openclip_encoder.py`; both use a scale of 10.

    Example:
        With cosines of 0.30 for the text and 0.25, 0.28, 0.20 and 0.22 for the phrases, only the nearest
        phrase matters: 1 / (1 + exp(-10 * 0.02)) = 0.549834.
    """
    return relevancy_of_margins(margins(embeddings, texts, canonical), scale)


@dataclass(frozen=True)
class PreparedView:
    """Everything about the latents of a view, with a linear code, that does not depend on the text."""

    channels: Float32[np.ndarray, "D P"]  # latents
    generic: Float32[np.ndarray, " P"]  # cosine with the nearest canonical phrase
    length: Float32[np.ndarray, " P"]  # length of each decoded vector before normalisation


class LatentRelevancy:
    """Relevancy of latents to texts, with fixed canonical phrases; results do not depend on `threads`."""

    def __init__(
        self, code: Code, canonical: Float32[np.ndarray, "K C"], scale: float, threads: int = 1
    ) -> None:
        self._code, self._canonical, self._scale, self._threads = code, canonical, scale, threads

    def exact(
        self, latents: Float32[np.ndarray, "P D"], texts: Float32[np.ndarray, "T C"]
    ) -> Float32[np.ndarray, "T P"]:
        """Compute relevancy by decoding every latent."""
        out = np.empty((len(texts), len(latents)), np.float32)

        def decode(span: slice) -> None:
            decoded = self._code.decode_array(np.ascontiguousarray(latents[span], np.float32))
            out[:, span] = relevancy(decoded, texts, self._canonical, self._scale)

        self._in_parts(decode, len(latents), CHUNK_ROWS)
        return out

    def prepare(self, latents: Float32[np.ndarray, "P D"]) -> PreparedView:
        """Prepare the latents of a view with a linear code for `fast`."""
        import cv2

        assert isinstance(self._code, LinearCode)
        offsets, slopes, mean_square, cross = self._code.cosine_terms(self._canonical)
        # Ten times as fast as numpy's transposition, but cv2 rejects arrays without rows.
        channels = cv2.transpose(latents) if len(latents) else latents.T
        length, generic = (np.empty(len(latents), np.float32) for _ in range(2))
        lengths_and_generic(channels, cross, np.float32(mean_square), offsets, slopes, length, generic)
        return PreparedView(channels, generic, length)

    def fast(self, view: PreparedView, texts: Float32[np.ndarray, "T C"]) -> Float32[np.ndarray, "T P"]:
        """Compute the relevancy at each pixel of a prepared view from d products per text.

        Each text's weights are computed separately, so that results do not depend on the other texts.
        """
        assert isinstance(self._code, LinearCode)
        out = np.empty((len(texts), len(view.generic)), np.float32)
        if not len(texts):
            return out
        terms = [self._code.cosine_terms(text[None])[:2] for text in texts]
        offsets, slopes = (np.concatenate(term).astype(np.float32) for term in zip(*terms, strict=True))
        scale = np.float32(self._scale)

        def look_up(span: slice) -> None:
            of_view = view.channels, view.length, view.generic, span.start
            texts_relevancy(*of_view, offsets, slopes, scale, out[:, span])

        self._in_parts(look_up, len(view.generic), ROWS_AT_A_TIME)
        return out

    def _in_parts(self, work: Callable[[slice], None], count: int, at_a_time: int) -> None:
        edges = [*range(0, count, at_a_time), count]
        over_edges(lambda begin, end: work(slice(begin, end)), edges, self._threads)
