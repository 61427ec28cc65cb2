"""Similarity of embeddings and texts: cosine margins, and LERF's relevancy, computed from these margins.

`LatentRelevancy` computes relevancy for every pixel of a view from its rendered latents. A linear code needs
no decoding; with a network, every pixel is decoded once per view (docs/field.md). Both forms are stored
channel by channel, so that the compiler can process eight or sixteen pixels at once. Memory bandwidth is the
bottleneck: three levels of a 986 x 728 view at d = 16 take 138 MB.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int16

from cpusplat.threads import over_edges
from hilsplat.base.errors import SettingsError
from hilsplat.field.code import CHUNK_ROWS, Code, LinearCode
from hilsplat.query.relevancy_kernels import lengths_and_generic, texts_relevancy

ROWS_AT_A_TIME = 1 << 16
"""Number of embeddings or pixels processed at once; it limits the size of products with many texts."""

ERROR = 2e-3  # maximum relevancy error at any pixel if the code is a network
RESIDUAL = 5e-5  # maximum root mean square of the decoded vectors' component outside the stored directions
SAMPLE = 8192  # number of latents in the sample from which the directions are computed

STEPS = 32767
"""Number of quantisation steps between coordinates 0 and 1; the rounding error is at most 1.5e-5."""


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
    """Latents or decoded vectors of a view, prepared for look-ups.

    Attributes:
        channels: latents (linear code), or coordinates along directions, in units of 1 / `STEPS` (network).
        generic: cosine with the nearest canonical phrase.
        length: length of each decoded vector before normalisation; empty with a network, whose are 1.
        directions: orthonormal rows; None with a linear code.
    """

    channels: Float32[np.ndarray, "D P"] | Int16[np.ndarray, "R P"]
    generic: Float32[np.ndarray, " P"]
    length: Float32[np.ndarray, " L"]
    directions: Float32[np.ndarray, "R C"] | None = None


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
        """Compute everything about the latents of a view that does not depend on the text."""
        if not isinstance(self._code, LinearCode):
            return self._prepare_projected(latents)
        import cv2

        offsets, slopes, mean_square, cross = self._code.cosine_terms(self._canonical)
        # Ten times as fast as numpy's transposition, but cv2 rejects arrays without rows.
        channels = cv2.transpose(latents) if len(latents) else latents.T
        length, generic = (np.empty(len(latents), np.float32) for _ in range(2))
        lengths_and_generic(channels, cross, np.float32(mean_square), offsets, slopes, length, generic)
        return PreparedView(channels, generic, length)

    def fast(self, view: PreparedView, texts: Float32[np.ndarray, "T C"]) -> Float32[np.ndarray, "T P"]:
        """Compute the relevancy at each pixel of a prepared view from a few products.

        Each text's weights are computed separately, so that results do not depend on the other texts.
        """
        out = np.empty((len(texts), len(view.generic)), np.float32)
        if not len(texts):
            return out
        if view.directions is None:
            assert isinstance(self._code, LinearCode)  # `prepare` made the view
            terms = [self._code.cosine_terms(text[None])[:2] for text in texts]
            offsets, slopes = (np.concatenate(term).astype(np.float32) for term in zip(*terms, strict=True))
        else:
            offsets = np.zeros(len(texts), np.float32)
            slopes = np.stack([view.directions @ text / STEPS for text in texts]).astype(np.float32)
        scale = np.float32(self._scale)

        def look_up(span: slice) -> None:
            of_view = view.channels, view.length, view.generic, span.start
            texts_relevancy(*of_view, offsets, slopes, scale, out[:, span])

        self._in_parts(look_up, len(view.generic), ROWS_AT_A_TIME)
        return out

    def _prepare_projected(self, latents: Float32[np.ndarray, "P D"]) -> PreparedView:
        """Decode all pixels, and add directions until no pixel's loss exceeds `lost_for_error`.

        The first directions are computed from a sample. While some pixels lose too much, such as those of a
        small unsampled object, further directions are computed from them, orthogonal to all previous ones;
        others get 0 along them. Each round uses at least one of the C directions, so the loop ends.
        """
        may_lose = lost_for_error(self._scale, self._code.channels)
        directions, others = self._directions(latents, np.eye(self._code.channels))
        coordinates, generic, lost = self._decode(latents, directions)
        missed = np.flatnonzero(lost > may_lose)
        while len(missed) and len(others):
            more, others = self._directions(latents[missed], others)
            directions = np.concatenate([directions, more])
            # Rows of zeros are added in place; a copy would store a large view twice.
            coordinates.resize((len(directions), len(latents)), refcheck=False)
            coordinates[:, missed], generic[missed], lost = self._decode(latents[missed], directions)
            missed = missed[lost > may_lose]
        return PreparedView(coordinates, generic, np.zeros(0, np.float32), directions)

    def _directions(
        self, latents: Float32[np.ndarray, "P D"], among: Float64[np.ndarray, "A C"]
    ) -> tuple[Float32[np.ndarray, "R C"], Float64[np.ndarray, "B C"]]:
        """Return the fewest directions with a loss of at most `RESIDUAL` on a decoded sample, and the others.

        `among` has one or more orthonormal rows; all directions are in their span (A = R + B).
        """
        some = self._code.decode_array(latents[:: max(1, -(-len(latents) // SAMPLE))]).astype(np.float64)
        values, turns = np.linalg.eigh(among @ (some.T @ some / max(len(some), 1)) @ among.T)
        lost = np.sqrt(np.maximum(np.cumsum(values), 0))  # of the smallest directions
        keep = max(1, int((lost > RESIDUAL).sum()))
        directions = turns.T @ among
        return directions[-keep:].astype(np.float32), directions[:-keep]

    def _decode(
        self, latents: Float32[np.ndarray, "P D"], directions: Float32[np.ndarray, "R C"]
    ) -> tuple[Int16[np.ndarray, "R P"], Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
        """Return each pixel's coordinates, cosine with the nearest phrase, and loss beyond the directions."""
        coordinates = np.empty((len(directions), len(latents)), np.int16)
        generic, lost = np.empty(len(latents), np.float32), np.empty(len(latents), np.float32)

        def decode(span: slice) -> None:
            vectors = self._code.decode_array(latents[span])
            generic[span] = (vectors @ self._canonical.T).max(axis=1)
            along = directions @ vectors.T
            coordinates[:, span] = np.rint(along * STEPS)
            # 1 minus the sum of squared coordinates is too imprecise: its error, 1e-7, is the square of 3e-4.
            outside = vectors - along.T @ directions
            lost[span] = np.sqrt(np.einsum("pc,pc->p", outside, outside))

        self._in_parts(decode, len(latents), CHUNK_ROWS)
        return coordinates, generic, lost

    def _in_parts(self, work: Callable[[slice], None], count: int, at_a_time: int) -> None:
        edges = [*range(0, count, at_a_time), count]
        over_edges(lambda begin, end: work(slice(begin, end)), edges, self._threads)


def lost_for_error(scale: float, channels: int) -> float:
    """Return the largest loss at which every relevancy error is at most `ERROR`.

    Relevancy is 1 / (1 + exp(-s (e.q - g))) with a unit text q. Only e.q has an error: at most the distance
    of e from its stored form, which is the loss outside the directions plus the rounding of C coordinates,
    sqrt(C) / (2 `STEPS`). The slope is at most s / 4. The directions may thus lose
    4 `ERROR` / s - sqrt(C) / (2 `STEPS`), which is 4.5e-4 with s = 10 and C = 512.

    Departs: the result is at least `RESIDUAL`. At s >= 20 (C = 512), 16 bits are too few for `ERROR`, and the
    relevancy error can reach s / 4 times the sum of `RESIDUAL` and rounding.
    """
    return max(4 * ERROR / scale - channels**0.5 / (2 * STEPS), RESIDUAL)
