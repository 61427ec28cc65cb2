"""Sparse products of the solver and of the linkage in torch, for CUDA devices.

The operators have the methods of `mask_operator.MaskOperator` and `quadratic.Quadratic`, with arrays as
inputs and outputs, and sums in the type of the input. Results equal those of the CPU up to rounding (tested).
The code also runs on torch's CPU backend, which tests use on machines without a device.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from hilsplat.base.levels import LEVELS
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.quadratic import Gram, Quadratic


def sparse_on(matrix: sp.csr_matrix, device: str) -> Tensor:
    """Copy a CSR matrix to a torch tensor."""
    return torch.sparse_csr_tensor(
        torch.from_numpy(matrix.indptr.astype(np.int64)),
        torch.from_numpy(matrix.indices.astype(np.int64)),
        torch.from_numpy(np.array(matrix.data)),
        size=matrix.shape,
    ).to(device)


@dataclass(frozen=True)
class DeviceMasks:
    """`MaskOperator` on a device: A of each level and its transpose."""

    rows: tuple[np.ndarray, ...]
    forward: tuple[Tensor, ...]
    backward: tuple[Tensor, ...]
    device: str

    @staticmethod
    def of(masks: MaskOperator, device: str) -> "DeviceMasks":
        """Copy A to the device."""
        A = sp.csr_matrix(
            (masks.data, masks.indices, masks.indptr), shape=(len(masks.level_index), masks.num_gaussians)
        )
        rows = tuple(np.flatnonzero(masks.level_index == level.index) for level in LEVELS)
        parts = [A[chosen] for chosen in rows]
        return DeviceMasks(
            rows,
            tuple(sparse_on(part, device) for part in parts),
            tuple(sparse_on(part.T.tocsr(), device) for part in parts),
            device,
        )

    def means(self, features: Float[np.ndarray, "N 3 D"]) -> Float[np.ndarray, "M D"]:
        """Return A F at each mask's level."""
        on_device = torch.from_numpy(np.ascontiguousarray(features)).to(self.device)
        out = np.zeros((sum(map(len, self.rows)), features.shape[2]), features.dtype)
        for index, (rows, part) in enumerate(zip(self.rows, self.forward, strict=True)):
            out[rows] = (part.to(on_device.dtype) @ on_device[:, index].contiguous()).cpu().numpy()
        return out

    def spread(self, values: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N 3 D"]:
        """Return A' x at each level."""
        on_device = torch.from_numpy(np.ascontiguousarray(values)).to(self.device)
        parts = [
            part.to(on_device.dtype) @ on_device[torch.from_numpy(rows).to(self.device)]
            for rows, part in zip(self.rows, self.backward, strict=True)
        ]
        return torch.stack(parts, dim=1).cpu().numpy()


@dataclass(frozen=True)
class DeviceQuadratic:
    """G or W on a device.

    Attributes:
        forward: W, or the upper triangle of G of each level.
        backward: W', or the strictly lower triangle of each level.
        valid: whether a pixel of W counts at each level; None for G.
        device: torch device.
        num_gaussians: N.
    """

    forward: tuple[Tensor, ...]
    backward: tuple[Tensor, ...]
    valid: Tensor | None
    device: str
    num_gaussians: int

    @staticmethod
    def of(quadratic: Quadratic, device: str) -> "DeviceQuadratic":
        """Copy G or W to the device."""
        num = quadratic.num_gaussians
        if not isinstance(quadratic, Gram):
            W = quadratic.weights
            return DeviceQuadratic(
                (sparse_on(W, device),),
                (sparse_on(W.T.tocsr(), device),),
                torch.from_numpy(quadratic.valid).to(device),
                device,
                num,
            )
        upper, lower = [], []
        for index in range(len(LEVELS)):
            values = np.ascontiguousarray(quadratic.values[:, index])
            part = sp.csr_matrix((values, quadratic.indices, quadratic.indptr), shape=(num, num))
            upper.append(sparse_on(part, device))
            lower.append(sparse_on(sp.triu(part, 1).T.tocsr(), device))
        return DeviceQuadratic(tuple(upper), tuple(lower), None, device, num)

    def product(self, features: Float[np.ndarray, "N 3 D"]) -> Float[np.ndarray, "N 3 D"]:
        """Return G_l F_l for every level."""
        on_device = torch.from_numpy(np.ascontiguousarray(features)).to(self.device)
        forward, backward = (
            [part.to(on_device.dtype) for part in parts] for parts in (self.forward, self.backward)
        )
        parts = []
        for index in range(len(LEVELS)):
            own = on_device[:, index].contiguous()
            if self.valid is None:
                parts.append(forward[index] @ own + backward[index] @ own)
            else:
                rendered = (forward[0] @ own) * self.valid[:, index : index + 1]
                parts.append(backward[0] @ rendered)
        return torch.stack(parts, dim=1).cpu().numpy()

    def form(self, features: Float[np.ndarray, "N 3 D"]) -> float:
        """Return the sum over levels of tr F'GF, in float64."""
        features = features.astype(np.float64)
        return float((features * self.product(features)).sum())


def shared_pairs_on(
    weighted: sp.csr_matrix,
    shares: sp.csr_matrix,
    sizes: sp.csr_matrix,
    visible: Bool[np.ndarray, "V N"],
    view: Int32[np.ndarray, " M"],
    device: str,
) -> tuple[sp.csr_matrix, Float[np.ndarray, "M V"]]:
    """Compute the products of the linkage's evidence: shared weights of pairs, and sizes visible per view.

    Args:
        weighted: w s of each mask and Gaussian.
        shares: s.
        sizes: contribution of each Gaussian to a mask's size.
        visible: whether a Gaussian is visible in a view.
        view: view of each mask.
        device: torch device.

    Returns:
        intersections of pairs of masks a < b of different views, and each mask's size in each view.
    """
    seen = sparse_on(sizes, device) @ torch.from_numpy(visible.T.astype(np.float64)).to(device)
    product = torch.sparse.mm(sparse_on(weighted, device), sparse_on(shares.T.tocsr(), device)).cpu()
    found = sp.csr_matrix(
        (product.values().numpy(), product.col_indices().numpy(), product.crow_indices().numpy()),
        shape=(len(view), len(view)),
    ).tocoo()
    keep = (found.row < found.col) & (view[found.row] != view[found.col])
    pairs = sp.csr_matrix((found.data[keep], (found.row[keep], found.col[keep])), shape=found.shape)
    pairs.sort_indices()
    return pairs, seen.cpu().numpy()
