"""Hierarchical consistency (HC): whether predicted parts are inside predicted wholes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool

Reading = Literal["containment", "literal", "anchored"]
READINGS: tuple[Reading, ...] = ("containment", "literal", "anchored")


@dataclass(frozen=True)
class Family:
    """Predicted masks of one annotated parent and its annotated children (at least one) in one view.

    `true_parent` is the parent's annotated region, used by the reading `anchored`.
    """

    parent: Bool[np.ndarray, "H W"]
    children: tuple[Bool[np.ndarray, "H W"], ...]
    true_parent: Bool[np.ndarray, "H W"]


def family_consistency(family: Family, reading: Reading) -> float:
    """Return the mean consistency of the children with their parent.

    `containment`: area(p and c) / area(c), the paper's wording; 1 for perfect nesting.
    `literal`: area(p and c) / area(p), the printed formula, with l = 1 for wholes.
    `anchored`: area(c and annotated p) / area(c), which doesn't reward predicting the whole image.
    An empty denominator (no prediction) gives 0.
    """
    anchor = family.true_parent if reading == "anchored" else family.parent
    terms = []
    for child in family.children:
        area = np.count_nonzero(family.parent if reading == "literal" else child)
        terms.append(np.count_nonzero(anchor & child) / area if area else 0.0)
    return float(np.mean(terms))


def hierarchical_consistency(
    transitions: Sequence[Sequence[Family]], reading: Reading = "containment"
) -> float:
    """Return the HC of one view (paper, Sec. IV, Eq. 7).

    HC is averaged over children, then parents, then levels, so every parent of a level has the same weight,
    regardless of its number of children. A scene's value is the mean over its views with at least one parent;
    then scenes are averaged.

    Departs: the printed normaliser uses N_l outside the sum over l, where it is undefined; here HC is the
    mean over the parents of each level, then over the L - 1 transitions. A transition without parents
    contributes 0, as max(N_l, 1) implies: in a view without subparts, even perfect nesting scores 0.5.

    Args:
        transitions: families grouped by the parent's level: wholes first, then parts.
    """
    scores = [[family_consistency(family, reading) for family in families] for families in transitions]
    return float(np.mean([np.mean(of_level) if of_level else 0.0 for of_level in scores]))
