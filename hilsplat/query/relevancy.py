"""How much an embedding answers a text: LERF's relevancy."""

import numpy as np
from jaxtyping import Float, Float32

CHUNK_ROWS = 65_536
"""Embeddings compared at once, so that products with many texts stay small."""


def relevancy(
    embeddings: Float[np.ndarray, "B C"],
    texts: Float[np.ndarray, "T C"],
    canonical: Float[np.ndarray, "K C"],
    scale: float = 10.0,
) -> Float32[np.ndarray, "T B"]:
    """Least softmax score of a text against each canonical phrase, in (0, 1).

    rel = min over k of exp(s e.q) / (exp(s e.q) + exp(s e.c_k)). An embedding as close to the text
    as to the nearest canonical phrase scores exactly 0.5: no better than generic.

    Source: LERF; LangSplat, `eval/openclip_encoder.py`.

    Args:
        embeddings: unit vectors.
        texts: unit vectors of the queries.
        canonical: unit vectors of the generic phrases, at least one.
        scale: of the cosines; LERF and LangSplat use 10.

    Example:
        cosines 0.30 with the text and 0.25, 0.28, 0.20, 0.22 with the phrases: the nearest phrase
        decides, 1 / (1 + exp(-10 * 0.02)) = 0.549834.
    """
    scores = np.empty((len(texts), len(embeddings)), np.float32)
    for start in range(0, len(embeddings), CHUNK_ROWS):
        part = embeddings[start : start + CHUNK_ROWS]
        generic = (part @ canonical.T).max(axis=1)
        margin = scale * (part @ texts.T - generic[:, None])
        scores[:, start : start + CHUNK_ROWS] = (1 / (1 + np.exp(-margin))).T
    return scores
