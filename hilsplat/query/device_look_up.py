"""Look-ups of relevancy by torch, for CUDA devices; tested on torch's CPU if there is none."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from hilsplat.query.linear_look_up import PlacedLinear
from hilsplat.query.projected_look_up import PlacedProjected


@dataclass(frozen=True)
class PlacedOnDevice:
    """What look-ups on the CPU keep of a view, on a device.

    Attributes:
        channels: latents or coordinates (R, P), in their stored type.
        length: of each decoded vector (P); None if these have unit length.
        generic: cosine with the nearest canonical phrase (P).
        directions: of the coordinates; None for latents.
    """

    channels: Tensor
    length: Tensor | None
    generic: Tensor
    directions: Float32[np.ndarray, "R C"] | None

    @staticmethod
    def of(placed: PlacedLinear | PlacedProjected, device: str) -> "PlacedOnDevice":
        """Copy to a device what the CPU's look-ups keep."""
        generic = torch.from_numpy(placed.generic).to(device)
        if isinstance(placed, PlacedLinear):
            channels, length = (torch.from_numpy(a).to(device) for a in (placed.channels, placed.length))
            return PlacedOnDevice(channels, length, generic, None)
        return PlacedOnDevice(
            torch.from_numpy(placed.coordinates).to(device), None, generic, placed.directions
        )

    @property
    def nbytes(self) -> int:
        """Memory held on the device and the host."""
        tensors = [self.channels, self.generic, *([] if self.length is None else [self.length])]
        return sum(tensor.nbytes for tensor in tensors) + (
            0 if self.directions is None else self.directions.nbytes
        )

    def relevancy(
        self, offset: np.float32, weights: Float[np.ndarray, " R"], scale: float
    ) -> Float32[np.ndarray, " P"]:
        """Relevancy of a text whose cosine is (offset + weights . channels) / length."""
        on_device = torch.from_numpy(np.ascontiguousarray(weights, np.float32)).to(self.generic.device)
        cosine = float(offset) + on_device @ self.channels.float()
        if self.length is not None:
            cosine = cosine / self.length
        return torch.sigmoid(float(scale) * (cosine - self.generic)).cpu().numpy()
