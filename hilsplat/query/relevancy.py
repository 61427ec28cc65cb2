"""How well an embedding matches a text: its cosine margin, and LERF's relevancy, computed from it."""

import numpy as np
from jaxtyping import Float, Float32

from hilsplat.base.errors import SettingsError

CHUNK_ROWS = 65_536
"""Embeddings to compare at once, so that products with many texts stay small."""


def margins(
    embeddings: Float[np.ndarray, "B C"],
    texts: Float[np.ndarray, "T C"],
    canonical: Float[np.ndarray, "K C"],
) -> Float32[np.ndarray, "T B"]:
    """Return the cosine with each text minus the cosine with the nearest canonical phrase, in [-2, 2].

    0 means as close to the text as to the nearest generic phrase. Embeddings are ranked and compared by
    margins, because relevancies saturate and margins do not.

    Args:
        embeddings: unit vectors.
        texts: unit vectors of the queries.
        canonical: unit vectors of the generic phrases, at least one.

    Example:
        cosines 0.30 with the text and 0.25, 0.28, 0.20, 0.22 with the phrases: 0.02.
    """
    found = np.empty((len(texts), len(embeddings)), np.float32)
    for start in range(0, len(embeddings), CHUNK_ROWS):
        part = embeddings[start : start + CHUNK_ROWS]
        generic = (part @ canonical.T).max(axis=1)
        found[:, start : start + CHUNK_ROWS] = (part @ texts.T - generic[:, None]).T
    return found


def relevancy_of_margins(margin: Float[np.ndarray, "*n"], scale: float) -> Float[np.ndarray, "*n"]:
    """Return the score that users and protocols see: 1 / (1 + exp(-scale * margin)), 0.5 at margin 0."""
    return 1 / (1 + np.exp(-scale * margin))


def margin_of_relevancy(score: float, scale: float) -> float:
    """Return the margin with a given score: the inverse of `relevancy_of_margins`.

    Raises:
        SettingsError: the score is not between 0 and 1.
    """
    if not 0 < score < 1:
        raise SettingsError(f"no answer has a score of {score:g} or more", expected="between 0 and 1")
    return float(np.log(score / (1 - score)) / scale)


def relevancy(
    embeddings: Float[np.ndarray, "B C"],
    texts: Float[np.ndarray, "T C"],
    canonical: Float[np.ndarray, "K C"],
    scale: float = 10.0,
) -> Float32[np.ndarray, "T B"]:
    """Return the lowest softmax score of a text against each canonical phrase, in (0, 1).

    rel = min over k of exp(s e.q) / (exp(s e.q) + exp(s e.c_k)), which is the logistic function of the
    scaled margin: an embedding at margin 0 scores exactly 0.5, no better than generic.

    Source: LERF; LangSplat, `eval/openclip_encoder.py`.

    Args:
        embeddings: unit vectors.
        texts: unit vectors of the queries.
        canonical: unit vectors of the generic phrases, at least one.
        scale: scale of the cosines; LERF and LangSplat use 10.

    Example:
        cosines 0.30 with the text and 0.25, 0.28, 0.20, 0.22 with the phrases: the nearest phrase
        decides, 1 / (1 + exp(-10 * 0.02)) = 0.549834.
    """
    return relevancy_of_margins(margins(embeddings, texts, canonical), scale)
