"""The reference trainer of the field: render one random view per step, after LangSplat and the paper.

Slow on purpose: it is the reference for the sparse solver, with the same Gaussians, masks and latents, the
loss on rendered pixels, and Adam on the features.

Departs from minghanqin/LangSplat `train.py`: views are drawn with replacement (there, each once before any is
repeated), one run trains the three levels on the same draws, rendered features are divided by alpha, thinly
covered pixels are left out, and features of Gaussians are not scaled to unit length before they are blended.
`hilsplat.methods.langsplat`, the baseline in the tables, departs in other ways; see there.
"""

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from torch import Tensor

from hilsplat.base.artifacts import read_index, sha256_of_file, write_json
from hilsplat.base.device import one_torch_thread
from hilsplat.base.levels import LEVELS, NONE
from hilsplat.base.progress import stage_log
from hilsplat.contributions.compositing import MIN_ALPHA
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps
from hilsplat.field.code import autoencoder_file, load_latents
from hilsplat.field.language_field import LanguageField, report_path
from hilsplat.field.losses.latent_regression import latent_regression_loss
from hilsplat.scene.finished import require_same
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import digests_in, load_masks
from hilsplat.settings import ReferenceSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import draw
from hilsplat.splat.rasterise.device import choose_device

logger = logging.getLogger(__name__)

CURVE_POINTS = 30
"""Points of the report's curve of loss over seconds."""


def rendered_loss(
    rendered: Float[Tensor, "H W C"],
    alpha: Float[Tensor, "H W"],
    labels: Int32[np.ndarray, "P 3"],
    latents: Float32[np.ndarray, "M D"],
    kind: str,
) -> Float[Tensor, ""]:
    """Regression of one rendered view to the latents of its masks, all levels.

    Args:
        rendered: blended features, the levels' channels side by side, premultiplied by alpha.
        alpha: coverage; thinly covered pixels do not count.
        labels: row of the painted mask at each pixel and level, -1 for none.
        latents: latents of the view's masks.
        kind: "l1": LangSplat's, absolute differences averaged over all pixels and channels, unlabelled
            pixels counting as 0; "squared": the language loss of the sparse solver, squared
            distances averaged over labelled pixels of all levels (`latent_regression_loss`).

    Returns:
        l1: the sum of the levels' means; squared: one mean.

    Departs: features are divided by alpha, so that both losses see what a query sees.
    """
    average = (rendered / alpha.clamp(min=1e-6)[..., None]).reshape(len(labels), len(LEVELS), -1)
    covered = alpha.detach().reshape(-1, 1) >= MIN_ALPHA
    rows = torch.from_numpy(labels).to(rendered.device).where(covered, NONE)
    targets = torch.from_numpy(latents).to(rendered.device)
    if kind == "squared":
        return latent_regression_loss(average, rows, targets)
    inside = rows != NONE
    return (average[inside] - targets[rows[inside].long()]).abs().sum() / (len(labels) * targets.shape[1])


class _Blended(torch.autograd.Function):
    """Features blended into a view, premultiplied, and the alpha, with the rasteriser's own gradients."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        features, gaussians, camera, threads, device = arguments
        values = features.detach().numpy()
        seen = draw(gaussians, camera, 0, features=values, threads=threads, device=device)
        ctx.gradients = seen.gradients
        return torch.from_numpy(seen.image[..., 3:]), torch.from_numpy(seen.alpha)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        by_image, by_alpha = (grad.numpy() for grad in grads)
        by_image = np.concatenate([np.zeros((*by_alpha.shape, 3), np.float32), by_image], axis=2)
        by_features = ctx.gradients(by_image, np.ascontiguousarray(by_alpha)).features
        return torch.from_numpy(by_features), None, None, None, None


def run_reference(
    scene_folder: Path,
    gaussians_ply: Path,
    masks_folder: Path,
    contributions_folder: Path,
    autoencoder_folder: Path,
    out: Path,
    settings: ReferenceSettings,
    device: str,
    seed: int,
    threads: int,
) -> None:
    """Train a field step by step, and write the same artifact as `field.run_field`.

    Features start from zero. The report beside the field holds the loss over steps and seconds.

    Args:
        contributions_folder: gives the order of masks; none of its matrices is read.
        device: "auto", "cpu" or "cuda" for the rasteriser.

    Raises:
        MisalignedArtifactError: the contributions belong to other Gaussians or other masks.
    """
    scene = Scene.load(scene_folder)
    gaussians = load_ply(gaussians_ply)
    contributions = Contributions.load(contributions_folder)
    require_same("contributions", scene.name, gaussians_ply, contributions.gaussians_sha256)
    latents = load_latents(autoencoder_folder, contributions)
    views = contributions.views
    digests = digests_in(contributions_folder)
    labels = [label_maps(load_masks(masks_folder, view, digests)) for view in views]
    own_latents = [latents[rows] for rows in contributions.rows_of_views()]
    chosen = choose_device(device)
    shape = (len(gaussians), len(LEVELS) * latents.shape[1])
    features = torch.zeros(shape, requires_grad=True)
    optimiser = torch.optim.Adam([features], lr=settings.rate, eps=1e-15)
    draws = np.random.default_rng(seed)
    curve: list[dict[str, float]] = []
    recent: list[float] = []
    log_every = max(1, settings.steps // CURVE_POINTS)
    start = time.perf_counter()
    with stage_log("reference field", scene.name) as counts, one_torch_thread():
        for step in range(1, settings.steps + 1):
            number = int(draws.integers(len(views)))
            camera = scene.cameras[views[number]]
            shown, alpha = _Blended.apply(features, gaussians, camera, threads, chosen)
            loss = rendered_loss(shown, alpha, labels[number], own_latents[number], settings.loss)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            recent.append(float(loss.detach()))
            if step % log_every == 0 or step == settings.steps:
                seconds = time.perf_counter() - start
                curve.append({"step": step, "loss": float(np.mean(recent)), "seconds": round(seconds, 2)})
                logger.info("reference field: step %d, loss %.5f", step, curve[-1]["loss"])
                recent = []
        found = features.detach().numpy().reshape(len(gaussians), len(LEVELS), latents.shape[1])
        LanguageField(
            np.ascontiguousarray(found, np.float32),
            contributions.gaussians_sha256,
            sha256_of_file(autoencoder_file(autoencoder_folder)),
        ).save(out)
        write_json(
            report_path(out),
            {
                "scene": read_index(contributions_folder)["scene"],
                "trainer": "reference",
                "loss": settings.loss,
                "curve": curve,
            },
        )
        counts |= {"steps": settings.steps, "Gaussians": len(gaussians)}
