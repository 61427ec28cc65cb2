"""The language field as colours, for pictures."""

import numpy as np
from jaxtyping import Float32


def field_colours(features: Float32[np.ndarray, "N D"]) -> Float32[np.ndarray, "N 3"]:
    """Three principal directions of a level's features over all Gaussians, stretched to [0, 1].

    The largest component of each direction is positive, and its 2nd to 98th percentile is stretched to the
    colour range, so that views share their colours. Gaussians without a feature are black; with fewer than
    three directions, the remaining channels are 0.
    """
    values = features.astype(np.float64)
    seen = np.square(values).sum(axis=1) > 0
    centred = values - values[seen].mean(axis=0) if seen.any() else values
    covariance = np.einsum("nc,nd->cd", centred[seen], centred[seen])
    _, directions = np.linalg.eigh(covariance)
    directions = directions[:, ::-1][:, :3]
    peak = np.abs(directions).argmax(axis=0)
    directions = directions * np.sign(directions[peak, np.arange(directions.shape[1])])
    colours = np.zeros((len(features), 3), np.float32)
    for channel, along in enumerate((centred @ directions).T):
        low, high = np.percentile(along[seen], (2, 98)) if seen.any() else (0.0, 1.0)
        colours[:, channel] = np.clip((along - low) / max(high - low, 1e-9), 0, 1) * seen
    return colours
