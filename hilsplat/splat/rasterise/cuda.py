"""Views of Gaussians on a card, blended by gsplat (extra `gpu`) with the conventions of the CPU backend.

Tests run this code on the CPU with gsplat's reference implementation in torch, and on a GPU if present.

gsplat works in float32 throughout: a Gaussian wider than about 1e9 px overflows.
"""

from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from scipy.sparse import csr_matrix
from torch import Tensor

from cpusplat.blend import MAX_ALPHA
from cpusplat.project import LOW_PASS_PX2, NEAR
from hilsplat.scene.cameras import Camera
from hilsplat.splat.gaussians import FIELDS, Gaussians
from hilsplat.splat.rasterise.api import refuse_broken, weight_matrix

DEVICE = "cuda"  # tests set this to `cpu` and use gsplat's reference implementation in torch
TILE = 16  # side of a gsplat tile, px
EVERYTHING = 2**31 - 1  # a number larger than any tile's batch index


class CardCamera(NamedTuple):
    size_hw: tuple[int, int]
    pose: Float[Tensor, "1 4 4"]  # cam_from_world
    K: Float[Tensor, "1 3 3"]
    centre: Float[Tensor, " 3"]

    @staticmethod
    def of(camera: Camera) -> "CardCamera":
        """Copy a camera to the device."""
        arrays = camera.cam_from_world[None], camera.K[None], camera.centre
        return CardCamera(
            camera.size_hw, *(torch.tensor(array, dtype=torch.float32, device=DEVICE) for array in arrays)
        )


class Entries(NamedTuple):
    """Blending weights of one view on the device, in CSR form: a row per pixel, columns are Gaussians."""

    start: Int64[Tensor, " P_and_1"]
    gaussian: Int64[Tensor, " E"]  # sorted within a pixel
    weight: Float[Tensor, " E"]  # positive
    num_gaussians: int

    @property
    def pixel(self) -> Int64[Tensor, " E"]:
        """Row of each entry."""
        return torch.arange(len(self.start) - 1, device=self.start.device).repeat_interleave(
            self.start.diff(), output_size=len(self.weight)
        )

    def on_host(self) -> csr_matrix:
        """Return the weights as a matrix (pixels x Gaussians)."""
        weights, columns, start = (
            tensor.cpu().numpy() for tensor in (self.weight, self.gaussian.int(), self.start)
        )
        return weight_matrix(weights, columns, start, self.num_gaussians)


def starts_of(count: Int64[Tensor, " n"]) -> Int64[Tensor, " n_and_1"]:
    """Return the start of each row, and the end of the last, given the number of entries per row."""
    return torch.cat([count.new_zeros(1), count.cumsum(0)])


def on_device(gaussians: Gaussians) -> dict[str, Tensor]:
    """Copy the fields of Gaussians to the device; raise an error if one cannot be drawn (`refuse_broken`)."""
    g = {name: torch.from_numpy(getattr(gaussians, name)).to(DEVICE) for name in FIELDS}
    refuse_broken(int(broken(g).sum()), len(gaussians))
    return g


def broken(g: dict[str, Tensor]) -> Bool[Tensor, " N"]:
    """Return whether each Gaussian cannot be drawn."""
    rows = (g["quats"] == 0).all(dim=1)
    for values in g.values():
        rows |= ~values.isfinite().reshape(len(values), -1).all(dim=1)
    return rows


def blend(
    g: dict[str, Tensor], camera: CardCamera, channels: Float[Tensor, "N C"]
) -> tuple[Float[Tensor, "H W C"], Float[Tensor, "H W"], dict[str, Any]]:
    """Blend channels of Gaussians on the device; return premultiplied image, alpha and intermediates."""
    import gsplat

    image, alpha, notes = gsplat.rasterization(
        g["means"],
        g["quats"],
        g["log_scales"].exp(),
        g["opacity_logits"].sigmoid(),
        channels,
        camera.pose,
        camera.K,
        camera.size_hw[1],
        camera.size_hw[0],
        near_plane=NEAR,
        radius_clip=0.0,
        eps2d=LOW_PASS_PX2,
        sh_degree=None,
        packed=False,
        tile_size=TILE,
        render_mode="RGB",
        rasterize_mode="classic",
    )
    return image[0], alpha[0, ..., 0], notes


@torch.no_grad()
def pixel_weights(g: dict[str, Tensor], camera: CardCamera, min_weight: float) -> Entries:
    """Return the blending weight of each Gaussian at each pixel; see `api.pixel_weights`.

    gsplat lists the Gaussians blended at each pixel; their weights are computed from the projected
    Gaussians. The list takes about 60 bytes per entry on the device (some 40 entries per pixel).
    """
    import gsplat

    height, width = camera.size_hw
    _, _, notes = blend(g, camera, g["means"][:, :1])
    who, pixel, _ = gsplat.rasterize_to_indices_in_range(
        0,
        EVERYTHING,
        torch.ones(1, height, width, device=DEVICE),
        notes["means2d"],
        notes["conics"],
        notes["opacities"],
        width,
        height,
        TILE,
        notes["isect_offsets"],
        notes["flatten_ids"],
    )
    # sort by pixel and keep the order within a pixel, front to back
    pixel, order = torch.sort(pixel, stable=True)
    who = who[order]
    dx = notes["means2d"][0, who, 0] - (pixel % width + 0.5)
    dy = notes["means2d"][0, who, 1] - (pixel // width + 0.5)
    conic = notes["conics"][0, who]
    power = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
    alpha = (g["opacity_logits"].sigmoid()[who] * torch.exp(-power)).clamp_max(MAX_ALPHA).double()
    count = torch.bincount(pixel, minlength=height * width)
    weight = alpha * _light_before(alpha, count)
    is_used = (weight >= min_weight) & (weight > 0)
    pixel, who, weight = pixel[is_used], who[is_used], weight[is_used]
    order = torch.argsort(pixel * len(g["means"]) + who)
    count = torch.bincount(pixel, minlength=height * width)
    return Entries(starts_of(count), who[order], weight[order].float(), len(g["means"]))


def _light_before(alpha: Float[Tensor, " E"], count: Tensor) -> Float[Tensor, " E"]:
    """Return the product of 1 - alpha over the preceding entries, within runs of `count` entries."""
    log_left = torch.log1p(-alpha)
    log_before = torch.cumsum(log_left, dim=0) - log_left
    begin = (torch.cumsum(count, dim=0) - count)[count > 0]
    return torch.exp(log_before - log_before[begin].repeat_interleave(count[count > 0]))
