"""Training-free lifting: the weighted average of mask codes at each Gaussian (the idea of Occam's LGS).

Departs: uses exact weights of all pixels of a mask instead of weights at projected centres, and the scene's
linear code (pca, 64) instead of 512 numbers.
"""

import numpy as np
from jaxtyping import Float32

from hilsplat.baselines import MethodSettings
from hilsplat.contributions.mask_operator import MaskOperator, lifted_average
from hilsplat.methods.method import MethodInputs


def fit(inputs: MethodInputs, settings: MethodSettings, seed: int) -> Float32[np.ndarray, "N 3 D"]:
    """Lift all levels, without training or randomness."""
    contributions = inputs.contributions
    masks = MaskOperator(contributions.matrix("A"), contributions.level)
    pixels = contributions.pixels.astype(np.float32)
    mass = masks.spread(pixels[:, None])[:, :, 0]
    return lifted_average(masks, mass, pixels, inputs.latents)
