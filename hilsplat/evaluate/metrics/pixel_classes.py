"""Every pixel gets one of the scene's classes: the original protocol of 3D-OVS.

Source: Kunhao-Liu/3D-OVS `renderer.py`. The IoU of a class is `masks.iou` of its pixels; a class absent
from prediction and truth gives 0 there (scikit-learn's default, which that code relies on).
"""

import numpy as np
from jaxtyping import Bool, Float


def argmax_masks(similarity: Float[np.ndarray, "K H W"]) -> Bool[np.ndarray, "K H W"]:
    """One mask per class: pixels where its similarity is largest; ties go to the first class.

    A pixel whose similarities are all -inf has no class.

    Args:
        similarity: cosine of each pixel's feature with each class text, no template, no canonical
            phrases. Classes in the order of the sorted texts, which decides ties.
    """
    winner = similarity.argmax(axis=0)
    answered = similarity.max(axis=0) > -np.inf
    return (winner[None] == np.arange(len(similarity))[:, None, None]) & answered


def pixel_accuracy(prediction: Bool[np.ndarray, "K H W"], truth: Bool[np.ndarray, "K H W"]) -> float:
    """Share of pixels whose classes are exactly the true ones.

    A pixel that the truth gives two classes or none is never right, as the prediction has one.
    """
    return float((prediction == truth).all(axis=0).mean())
