"""The hierarchical clustering loss L_h (paper, Eq. 2) pixel by pixel; the solver has a matrix product."""

from jaxtyping import Float, Int
from torch import Tensor


def clustering_loss(features: Float[Tensor, "H W D"], labels: Int[Tensor, "H W"]) -> Float[Tensor, ""]:
    """Pull rendered features to the mean of their mask: one view and level of L_h (Eq. 2).

    Departs: Eq. 2 sums over pixels and masks; we average over the labelled pixels, so that its
    weight does not depend on the image size. Masks are those of the painted label map, thus
    disjoint. The gradient flows through the mean.

    Args:
        features: rendered features, divided by the accumulated alpha.
        labels: row of the mask at each pixel, -1 where there is none.

    Returns:
        mean over labelled pixels of the squared distance to the mask's mean.
    """
    inside = labels >= 0
    rows = labels[inside].long()
    values = features[inside]
    num_masks = int(rows.max()) + 1 if len(rows) else 0
    counts = values.new_zeros(num_masks).index_add(0, rows, values.new_ones(len(rows)))
    sums = values.new_zeros(num_masks, values.shape[1]).index_add(0, rows, values)
    means = sums / counts.clamp(min=1)[:, None]
    return (values - means[rows]).square().sum() / max(len(rows), 1)
