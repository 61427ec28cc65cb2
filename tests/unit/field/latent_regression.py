"""The language loss pixel by pixel; the solver has a matrix product."""

from jaxtyping import Float, Int
from torch import Tensor


def latent_regression_loss(
    features: Float[Tensor, "H W D"], labels: Int[Tensor, "H W"], latents: Float[Tensor, "M D"]
) -> Float[Tensor, ""]:
    """Mean squared distance between rendered features and mask latents of one view.

    Departs: the paper's objective has no term that involves CLIP, and collapses without one. This is
    LangSplat's regression with the squared instead of the absolute difference, so that it is a quadratic form
    of the field, and the mean runs over labelled pixels, not all.

    Args:
        features: rendered features, divided by the accumulated alpha; of one level at H x W pixels, or of
            all levels at once, pixels along H and levels along W.
        labels: row of the mask at each of these places, -1 for none.
        latents: latent of each mask.

    Returns:
        mean over labelled places of the squared distance; 0 if no pixel is labelled.
    """
    inside = labels >= 0
    residual = features[inside] - latents[labels[inside].long()]
    return residual.square().sum() / inside.sum().clamp(min=1)
