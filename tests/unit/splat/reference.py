"""Slow, obvious rendering in float64 torch, with which the fast backends are compared.

Every Gaussian is evaluated at every pixel, and gradients are torch's own. It shares no code with the
backends, and repeats their constants and formulas on purpose.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians

SH = (
    lambda x, y, z: 0.28209479177387814 + 0 * x,
    lambda x, y, z: -0.4886025119029199 * y,
    lambda x, y, z: 0.4886025119029199 * z,
    lambda x, y, z: -0.4886025119029199 * x,
    lambda x, y, z: 1.0925484305920792 * x * y,
    lambda x, y, z: -1.0925484305920792 * y * z,
    lambda x, y, z: 0.31539156525252005 * (2 * z * z - x * x - y * y),
    lambda x, y, z: -1.0925484305920792 * x * z,
    lambda x, y, z: 0.5462742152960396 * (x * x - y * y),
    lambda x, y, z: -0.5900435899266435 * y * (3 * x * x - y * y),
    lambda x, y, z: 2.890611442640554 * x * y * z,
    lambda x, y, z: -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
    lambda x, y, z: 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
    lambda x, y, z: -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
    lambda x, y, z: 1.445305721320277 * z * (x * x - y * y),
    lambda x, y, z: -0.5900435899266435 * x * (x * x - 3 * y * y),
)
"""Real spherical harmonics in the order and with the signs of 3DGS."""


def rotations(quats: Float[Tensor, "N 4"]) -> Float[Tensor, "N 3 3"]:
    """Rotation matrices of quaternions wxyz of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


class Tensors(NamedTuple):
    """Gaussians as tensors; fields as in `Gaussians`."""

    means: Float[Tensor, "N 3"]
    log_scales: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    opacity_logits: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]


def render_reference(
    gaussians: Gaussians | Tensors,
    camera: Camera,
    sh_degree: int,
    features: Float[Tensor, "N D"] | None = None,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"], Float[Tensor, "N H W"]]:
    """Premultiplied RGB (+ features), alpha, and the blending weights, in float64."""
    g = Tensors(*(torch.as_tensor(getattr(gaussians, name)).double() for name in FIELDS))
    height, width = camera.size_hw
    cam_from_world, K = torch.from_numpy(camera.cam_from_world), torch.from_numpy(camera.K)
    cam = g.means @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    x, y, z = cam.unbind(1)
    drawn = z > 0.01
    z = torch.where(drawn, z, torch.ones_like(z))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    ray_x = (x / z).clamp(-cx / fx - margin_x, (width - cx) / fx + margin_x)
    ray_y = (y / z).clamp(-cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx / z * ray_x], dim=1),
            torch.stack([zero, fy / z, -fy / z * ray_y], dim=1),
        ],
        dim=1,
    )
    root = jacobian @ cam_from_world[:3, :3] @ rotations(g.quats) * g.log_scales.exp()[:, None]
    covariance = root @ root.transpose(1, 2) + 0.3 * torch.eye(2, dtype=torch.float64)
    conic = torch.linalg.inv(covariance)
    centre = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)

    direction = torch.nn.functional.normalize(g.means - torch.from_numpy(camera.centre), dim=1)
    basis = torch.stack([f(*direction.unbind(1)) for f in SH[: (sh_degree + 1) ** 2]], dim=1)
    colours = (torch.einsum("nk,nkc->nc", basis, g.sh[:, : basis.shape[1]]) + 0.5).clamp(min=0)
    if features is not None:
        colours = torch.cat([colours, features.double()], dim=1)

    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64) + 0.5,
        torch.arange(width, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    offset = centre[:, None, None] - torch.stack([columns, rows], dim=-1)
    power = -0.5 * torch.einsum("nhwi,nij,nhwj->nhw", offset, conic, offset)
    alpha = (g.opacity_logits.sigmoid()[:, None, None] * power.exp()).clamp(max=0.999)
    alpha = torch.where((alpha >= 1 / 255) & drawn[:, None, None], alpha, torch.zeros_like(alpha))
    order = torch.argsort(z, stable=True)
    alpha = alpha[order]
    light = torch.cumprod(1 - alpha, dim=0)
    # once a Gaussian would leave too little light, neither it nor those behind it are blended
    open_ = torch.cummin((light > 1e-4).double(), dim=0).values
    before = torch.cat([torch.ones_like(light[:1]), light[:-1]])
    weights = alpha * before * open_
    image = torch.einsum("nhw,nc->hwc", weights, colours[order])
    by_row = torch.empty_like(weights)
    by_row[order] = weights
    return image, weights.sum(dim=0), by_row
