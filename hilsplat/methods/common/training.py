"""Train Gaussians' features on rendered mask pixels, with frozen geometry, for grouping methods.

A step renders random labelled pixels of one random view as a product with compositing weights, which are
computed once per view. Losses are written in torch and differentiated automatically.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from hilsplat.base.progress import track
from hilsplat.baselines import TrainedSettings
from hilsplat.field.adam import in_random_order
from hilsplat.methods.method import LabelledView

PIXELS = 4096  # maximum per step; published codes use 4096 (VCH), 32,768 (OmniSeg3D) or whole views
START_NOISE = 0.1  # standard deviation of initial features about their common value


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Make torch sum in a fixed order, so that results do not depend on the stage's number of threads.

    torch stores its thread count per thread, so each thread of a pool must enter this context itself.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Product(torch.autograd.Function):
    """Product of a constant sparse matrix and features, by scipy, because torch's is slower and in beta."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, matrix: sp.csr_matrix) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ features.detach().numpy())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.matrix.T @ gradients[0].contiguous().numpy()), None


def product(matrix: sp.csr_matrix, features: Float[Tensor, "N D"]) -> Float[Tensor, "p D"]:
    """Return rendered features W F or mask means A F; differentiable with respect to the features."""
    return _Product.apply(features, matrix)  # type: ignore[no-untyped-call]


def nonempty_columns(matrix: sp.csr_matrix) -> tuple[sp.csr_matrix, Int64[Tensor, " s"]]:
    """Return the matrix without empty columns, and the indices of the others; a step shows few Gaussians."""
    columns, column_of_entry = np.unique(matrix.indices, return_inverse=True)
    parts = matrix.data, column_of_entry.reshape(-1), matrix.indptr
    small = sp.csr_matrix(parts, shape=(matrix.shape[0], len(columns)))
    return small, torch.from_numpy(columns.astype(np.int64))


def unit(rows: Float[Tensor, "*n D"]) -> Float[Tensor, "*n D"]:
    """Return rows scaled to length 1; a row of zeros is unchanged."""
    return rows / rows.norm(dim=-1, keepdim=True).clamp(min=1e-9)


def initial_features(num_gaussians: int, channels: int, seed: int) -> Float[Tensor, "N D"]:
    """Return trainable initial features that are almost the same for all Gaussians.

    Gaussians with equal features stay together unless a mask separates them; with independent starts, each
    Gaussian would retain some of its initial feature.
    """
    draw = torch.Generator().manual_seed(seed)
    start = torch.randn(1, channels, generator=draw)
    return (start + START_NOISE * torch.randn(num_gaussians, channels, generator=draw)).requires_grad_()


Loss = Callable[[LabelledView, np.random.Generator, float], Tensor]
"""Loss over the given pixels of a view; the number is the share of completed steps."""


def train(
    views: list[LabelledView],
    parameters: list[Any],  # tensors, or parameter groups of `torch.optim.Adam` with their own rates
    loss: Loss,
    settings: TrainedSettings,
    seed: int,  # for the order of views and the pixels
    pixels: int = PIXELS,  # maximum per step
) -> None:
    """Minimise in place with Adam: each step uses one view; each view is used once before any is repeated."""
    random = np.random.default_rng(seed)
    with one_torch_thread():
        optimiser = torch.optim.Adam(parameters, settings.rate, eps=1e-15)
        order = in_random_order(views, random, settings.steps)
        for step, view in enumerate(track(order, "steps", total=settings.steps)):
            chosen = random.permutation(len(view.labels))[:pixels]
            optimiser.zero_grad()
            loss(view.chosen(chosen), random, step / settings.steps).backward()
            optimiser.step()


def segment_means(
    values: Float[Tensor, "p D"], segment: Int64[Tensor, " p"], num: int
) -> tuple[Float[Tensor, "m D"], Float[Tensor, " m"]]:
    """Return the mean of each segment's rows (0 if empty), and the number of its rows."""
    counts = torch.bincount(segment, minlength=num).to(values.dtype)
    sums = torch.zeros(num, values.shape[1], dtype=values.dtype).index_add(0, segment, values)
    return sums / counts.clamp(min=1)[:, None], counts
