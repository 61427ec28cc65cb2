"""A differentiable rasteriser of 3D Gaussians for the CPU, with gsplat's call; see README.md."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cpusplat.adam import adam_step
    from cpusplat.gsplat_call import rasterization
    from cpusplat.photometric import photometric_loss, psnr, ssim

__all__ = ["adam_step", "photometric_loss", "psnr", "rasterization", "ssim"]

_MODULES = {"adam_step": "adam", "rasterization": "gsplat_call"}


def __getattr__(name: str) -> Any:
    """Load a public function, and numba, on first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"cpusplat.{_MODULES.get(name, 'photometric')}"), name)
