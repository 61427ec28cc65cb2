"""The stage `clip`: one CLIP vector per mask of every training view."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import (
    ViewCache,
    atomic_folder,
    sha256_of_file,
    sha256_of_json,
    write_index,
    write_npy,
)
from hilsplat.base.errors import MisalignedArtifactError
from hilsplat.base.identity import code_digest
from hilsplat.base.parallel import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.embed.clip import ClipModel
from hilsplat.models.memory import available_mib, needs_of
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks
from hilsplat.settings import ClipSettings


def run_clip(
    scene_folder: Path,
    masks_folder: Path,
    out: Path,
    cache: Path,
    settings: ClipSettings,
    threads: int,
    memory_mib: float | None = None,
) -> None:
    """Embed every mask of every training view.

    Args:
        scene_folder: the `Scene` artifact.
        masks_folder: output of the masks stage.
        out: folder to write: `<view>.npy`, float16 (M, C) unit vectors with rows as the masks, and
            `index.json` with the number C and the model.
        cache: folder of the view cache.
        settings: model and cropping.
        threads: views embedded at once, if they fit into the memory; the result does not depend on it.
        memory_mib: memory that the stage may use; None: what is free.

    Raises:
        MisalignedArtifactError: the masks belong to other views or sizes than the scene's, or are not
            those that their index records.
    """
    scene = Scene.load(scene_folder)
    digests = digests_in(masks_folder)
    views = list(digests)
    model = ClipModel.load(Path(settings.model), variant=settings.variant)
    needs = needs_of(model.model, settings.batch)
    threads = needs.views_at_once(threads, min(memory_mib or math.inf, available_mib()))
    view_cache = ViewCache(Path(cache) / "clip")

    def embed(view: str) -> np.ndarray:
        key = sha256_of_json(
            {
                "image": sha256_of_file(scene.image_path(view)),
                "masks": digests[view],
                "model": model.digest,
                "providers": model.vision.providers,
                "settings": settings.model_dump(exclude={"model", "variant"}),
                "code": code_digest(ClipModel),
            }
        )

        def compute() -> dict[str, np.ndarray]:
            masks = load_masks(masks_folder, view, digests)
            if masks.size_hw != scene.cameras[view].size_hw:
                raise MisalignedArtifactError(
                    f"masks of view {view} of {scene.name} do not fit its camera",
                    expected=f"{scene.cameras[view].size_hw} (height, width)",
                    found=f"{masks.size_hw}",
                    fix="run the masks stage again for this scene",
                )
            return {"clip": model.embed_masks(scene.image(view), masks, settings)}

        return view_cache.get(key, compute)["clip"]

    strangers = sorted(set(views) - set(scene.views("train")))
    if strangers:
        raise MisalignedArtifactError(
            f"masks in {masks_folder} do not belong to the training views of {scene.name}",
            expected=f"only masks of its {len(scene.views('train'))} training views",
            found=", ".join(strangers[:5]),
            fix="run the masks stage again for this scene",
        )
    with stage_log("clip", scene.name) as counts, atomic_folder(out) as folder:
        index: dict[str, dict[str, Any]] = {}
        found = in_order(embed, views, threads)
        dimensions = 0
        for view, vectors in zip(views, track(found, "CLIP of views", len(views)), strict=True):
            write_npy(folder / f"{view}.npy", vectors)
            index[view] = {MASKS_SHA256: digests[view], "masks": len(vectors)}
            dimensions = vectors.shape[1]
        write_index(
            folder,
            index,
            scene=scene.name,
            dim=dimensions,
            model=settings.model,
            model_variant=settings.variant,
            model_sha256=model.digest,
            background=settings.background,
        )
        counts.update(
            views=len(views),
            masks=sum(entry["masks"] for entry in index.values()),
            dim=dimensions,
            from_cache=view_cache.hits,
        )
