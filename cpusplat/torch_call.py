"""Autograd of `ActivatedViews` for torch tensors."""

from typing import Any

import torch
from torch import Tensor

from cpusplat.activated import ActivatedViews


def draw(
    views: ActivatedViews,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return images, alphas, projected means and depths, connected by autograd in this order.

    Gradients of the images reach the Gaussians through the projected means and depths, so that these gather
    gradients too. The shape and opacity at the pixels depend on the Gaussians in ways that no other output
    shows; `link`, an empty tensor, stands for them in the graph.
    """
    harmonics = colours[:, : views.sh.shape[1]] if views.has_harmonics and colours is not None else None
    means2d, depths, link = _Projection.apply(views, means, quats, scales, opacities, harmonics)
    images, alphas = _Blending.apply(views, means2d, depths, link, None if views.has_harmonics else colours)
    return images, alphas, means2d, depths


def _require_first_order() -> None:
    if torch.is_grad_enabled():  # the result would silently count as a constant
        raise NotImplementedError("second-order gradients (create_graph=True) are not supported")


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, views: ActivatedViews, *parameters: Tensor | None) -> tuple[Tensor, ...]:
        ctx.views = views
        ctx.save_for_backward(*parameters)  # torch refuses the way back if one was modified in place
        return *map(torch.from_numpy, views.project()), torch.zeros(1)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        _require_first_order()
        _ = ctx.saved_tensors
        by_mean_px, by_depth, by_link = (grad.numpy() for grad in grads)
        gradients = ctx.views.project_backward(by_mean_px, by_depth, bool(by_link[0]))
        *by_parameter, by_sh = map(torch.from_numpy, gradients)
        return None, *by_parameter, by_sh if ctx.views.has_harmonics else None


class _Blending(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, views: ActivatedViews, *inputs: Tensor | None) -> tuple[Tensor, ...]:
        colours = inputs[3]
        ctx.views, ctx.has_colours = views, colours is not None
        ctx.has_shared_colours = colours is not None and colours.ndim == 2
        return tuple(map(torch.from_numpy, views.blend()))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        _require_first_order()
        gradients = ctx.views.blend_backward(*(grad.contiguous().numpy() for grad in grads))
        by_mean_px, by_depth, by_colour = map(torch.from_numpy, gradients)
        by_colour = by_colour.sum(dim=0) if ctx.has_shared_colours else by_colour
        return None, by_mean_px, by_depth, torch.ones(1), by_colour if ctx.has_colours else None
