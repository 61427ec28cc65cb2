"""Relevancy look-ups in torch for CUDA devices; tests use torch's CPU if there is none."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from hilsplat.query.linear_look_up import PlacedLinear
from hilsplat.query.projected_look_up import PlacedProjected


@dataclass(frozen=True)
class PlacedOnDevice:
    """Data that the CPU look-ups store per view, copied to a device.

    Attributes:
        channels: latents or coordinates (R, P), in their stored type.
        length: length of each decoded vector (P); None if all have unit length.
        generic: cosine with the nearest canonical phrase (P).
        directions: directions of the coordinates; None for latents.
    """

    channels: Tensor
    length: Tensor | None
    generic: Tensor
    directions: Float32[np.ndarray, "R C"] | None

    @staticmethod
    def of(placed: PlacedLinear | PlacedProjected, device: str) -> "PlacedOnDevice":
        """Copy the data of a CPU look-up to a device."""
        generic = torch.from_numpy(placed.generic).to(device)
        if isinstance(placed, PlacedLinear):
            channels, length = (torch.from_numpy(a).to(device) for a in (placed.channels, placed.length))
            return PlacedOnDevice(channels, length, generic, None)
        return PlacedOnDevice(
            torch.from_numpy(placed.coordinates).to(device), None, generic, placed.directions
        )

    @property
    def nbytes(self) -> int:
        """Memory used on the device and the host, bytes."""
        tensors = [self.channels, self.generic, *([] if self.length is None else [self.length])]
        return sum(tensor.nbytes for tensor in tensors) + (
            0 if self.directions is None else self.directions.nbytes
        )

    def relevancy(
        self, offset: np.float32, weights: Float[np.ndarray, " R"], scale: float
    ) -> Float32[np.ndarray, " P"]:
        """Return the relevancy of a text whose cosine is (offset + weights . channels) / length."""
        on_device = torch.from_numpy(np.ascontiguousarray(weights, np.float32)).to(self.generic.device)
        cosine = float(offset) + on_device @ self.channels.float()
        if self.length is not None:
            cosine = cosine / self.length
        return torch.sigmoid(float(scale) * (cosine - self.generic)).cpu().numpy()
