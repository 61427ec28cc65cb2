"""Memory use of models, which limits the number of views processed at once."""

import math
from dataclasses import dataclass
from typing import Any

from hilsplat.base.errors import ModelError, foreign
from hilsplat.base.memory import MIB, available_mib
from hilsplat.models.folder import ModelFolder, input_side_px
from hilsplat.models.layouts import LAYOUTS

PROCESS_MIB = 1500  # memory of a stage without its networks: libraries, images, candidates, masks
ATTENTION_COPIES = 3.5
"""Number of arrays as large as a layer's attention weights that are in memory at once. Measured: 2615 MiB for
an image in SAM ViT-B, whose attention weights take 768 MiB."""
ACTIVATIONS = 35
"""Memory of an image in SAM with row-wise attention, in multiples of all patch features. Measured: 475 MiB in
ViT-B, whose patch features take 12 MiB."""
PROMPT_MIB = 64
"""Memory per prompt in SAM's exported decoder, for a 1024 px image. Measured: 507 MiB for 8 (ViT-B)."""
FACTORED_MIB = 250
"""Memory that the factored decoder needs for a 1024 px image. Measured: 104 MiB while 1024 prompts are
previewed, plus the masks of the prompts that are kept."""
CLIP_TOKEN_MIB = 0.03
"""Memory per patch of a crop in a CLIP model, not counting two arrays of attention weights. Measured: 521 MiB
for 64 crops in ViT-B/16."""
CARD_CROPS = 64  # crops of a card's first call
SAM_HEADS, SAM2_HEADS = 12, 4
"""Attention heads if the configuration does not specify them (SAM 2 and EdgeTAM: of the global attention)."""
UNKNOWN_BYTES_PER_PX = 400
"""Memory for encoding an image, per pixel, if the configuration does not describe the network (sam-tiny)."""


@dataclass(frozen=True)
class Needs:
    """Memory use of a model: of the open networks, and of each view processed at the same time."""

    weights_mib: float
    view_mib: float

    def total_mib(self, views: int) -> int:
        """Return the memory of a stage that processes this many views at once, MiB."""
        return round(PROCESS_MIB + self.weights_mib + views * self.view_mib)

    def views_at_once(self, threads: int, memory_mib: float | None) -> int:
        """Return the number of views that fit into free memory: at most one per thread, and at least one.

        `memory_mib` limits the memory further, unless it is None.
        """
        memory_mib = min(available_mib(), memory_mib or math.inf)
        fitting = int((memory_mib - PROCESS_MIB - self.weights_mib) // self.view_mib)
        return max(1, min(threads, fitting))


def needs_of(
    model: ModelFolder, batch: int, *, as_exported: bool = False, num_bytes: int | None = None
) -> Needs:
    """Estimate the memory of a model from its configuration and file sizes.

    Args:
        batch: prompts (SAM) or crops (CLIP) per call.
        as_exported: as in `SamModel`.
        num_bytes: size of the networks; None for the size of the folder's files.

    Raises:
        ModelError: the configuration does not contain numbers.
    """
    if num_bytes is None:
        described = {model.folder / name for name in LAYOUTS[model.layout].described}
        num_bytes = sum(path.stat().st_size for path in model.files if path not in described)
    side, weights = input_side_px(model), 1.2 * num_bytes / MIB
    vision = model.config.get("vision_config", model.config.get("vision_cfg"))
    fix = "correct it, or fetch a complete copy of the model"
    with foreign(f"{model.folder / 'config.json'}: vision_config", ModelError, fix=fix):
        if not isinstance(vision, dict):
            image, as_exported = side * side * UNKNOWN_BYTES_PER_PX / MIB, True
        elif model.kind == "clip":
            image = 2 * _attention_mib(vision, side) + CLIP_TOKEN_MIB * (side / _patch_px(vision)) ** 2
        elif model.layout == "sam" and not as_exported:
            patches = side / _patch_px(vision)
            features = patches**2 * vision.get("hidden_size", 768) * 4 / MIB
            image = ACTIVATIONS * features + ATTENTION_COPIES * _attention_mib(vision, side) / patches
        else:
            heads = SAM2_HEADS if model.layout == "sam2" else SAM_HEADS
            image = ATTENTION_COPIES * _attention_mib(vision, side, heads)
    if model.kind == "clip":
        return Needs(weights, batch * image)
    decoder = batch * PROMPT_MIB if as_exported else FACTORED_MIB
    return Needs(weights, image + decoder * (side / 1024) ** 2)


def card_mib(model: ModelFolder) -> float:
    """Estimate the memory of a model on a card, where one view or batch is processed at a time, MiB."""
    needs = needs_of(model, CARD_CROPS if model.kind == "clip" else 1, as_exported=True)
    return needs.weights_mib + needs.view_mib


def _attention_mib(vision: dict[str, Any], side_px: int, default_heads: int = SAM_HEADS) -> float:
    """Return the memory of one layer's attention weights between all patches of an image, MiB.

    Keys missing from the configuration get the defaults of transformers, such as patches of 16 px. In SAM 2,
    the stage with global attention has a stride of 16 px.
    """
    stages = (vision.get("backbone_config") or {}).get("num_attention_heads_per_stage")
    heads = stages[2] if stages else vision.get("num_attention_heads", default_heads)
    return heads * (side_px / _patch_px(vision)) ** 4 * 4 / MIB


def _patch_px(vision: dict[str, Any]) -> int:
    return vision.get("patch_size") or 16  # open_clip's ResNets have null
