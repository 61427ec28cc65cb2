"""gsplat's functions on the CPU, in float64, as the reference of both backends."""

import torch
from jaxtyping import Float
from torch import Tensor

from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import Gaussians
from tests.cpusplat.gsplat_on_cpu import rasterization, spherical_harmonics


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
    height, width = camera.size_hw
    given = means, quats, log_scales.exp(), logits.sigmoid(), channels, pose[None], K[None], width, height
    options = {"radius_clip": 0, "rasterize_mode": "classic", "packed": False, "sh_degree": None}
    image, alpha, _ = rasterization(*given, near_plane=0.01, eps2d=0.3, **options)
    return image[0], alpha[0, ..., 0]
