"""Classification of every pixel into the scene's classes: the original protocol of 3D-OVS.

Source: Kunhao-Liu/3D-OVS `renderer.py`. The IoU of a class is `masks.iou` of its pixels; a class absent from
prediction and truth gives 0 there (the default of scikit-learn, used by that code).
"""

import numpy as np
from jaxtyping import Bool, Float


def argmax_masks(similarity: Float[np.ndarray, "K H W"]) -> Bool[np.ndarray, "K H W"]:
    """Return one mask per class: pixels where its similarity is largest; the first class wins ties.

    A pixel whose similarities are all -inf has no class.

    Args:
        similarity: cosine of each pixel's feature with each class text, without template or canonical
            phrases. Classes are in the order of the sorted texts, which determines ties.
    """
    winner = similarity.argmax(axis=0)
    answered = similarity.max(axis=0) > -np.inf
    return (winner[None] == np.arange(len(similarity))[:, None, None]) & answered


def pixel_accuracy(prediction: Bool[np.ndarray, "K H W"], truth: Bool[np.ndarray, "K H W"]) -> float:
    """Return the share of pixels whose classes are exactly the true ones.

    A pixel with two true classes or none is never correct, because the prediction has one.
    """
    return float((prediction == truth).all(axis=0).mean())
