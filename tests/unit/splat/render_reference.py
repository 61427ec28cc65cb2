"""gsplat's functions on the CPU, in float64, as the reference of both backends."""

import torch
from jaxtyping import Float
from torch import Tensor

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from tests.cpusplat.gsplat_on_cpu import rasterization_of_view, spherical_harmonics


def render_reference(
    gaussians: Gaussians | list[Tensor],
    camera: Camera,
    degree: int,
    features: Float[Tensor, "N D"] | None = None,
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"]]:
    """Premultiplied RGB (+ features) and alpha; every Gaussian is evaluated at every pixel, in float64."""
    fields = gaussians if isinstance(gaussians, list) else vars(gaussians).values()
    means, log_scales, quats, logits, sh = (torch.as_tensor(field).double() for field in fields)
    pose, K, centre = map(torch.from_numpy, (camera.cam_from_world, camera.K, camera.centre))
    channels = (spherical_harmonics(degree, means - centre, sh) + 0.5).clamp(min=0)
    if features is not None:
        channels = torch.cat([channels, features.double()], dim=1)
    given = means, quats, log_scales.exp(), logits.sigmoid(), channels
    image, alpha, _ = rasterization_of_view(*given, pose, K, *camera.size_hw[::-1])
    return image[0], alpha[0, ..., 0]
