"""Stage `contributions`: the weight of each Gaussian in each mask, with frozen geometry.

For a view with compositing weights W (pixels x Gaussians, rows divided by their sum) and its masks painted
into one label map per level, with indicator B and areas n, the stage computes

- A = diag(1/n) B W: the mean weight of each Gaussian in each mask; A F are the mask means,
- G_l = sum over views of W' diag(valid_l) W (see `quadratic`),
- A_half: A over a random half of each mask's pixels, for the part loss,
- S = D W with the raw, overlapping masks D: the visible weight of each Gaussian in each mask,
- mass: the visible weight of each Gaussian in each view.

The language field's losses and the semantic tree need no other data from the images.
"""

import logging
import math
from functools import cache as cache_calls
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from hilsplat.base.arrays import require_types
from hilsplat.base.artifacts import read_index, write_index, write_npz
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.lineage import sha256_of_bytes, sha256_of_file, sha256_of_json
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.quadratic import Gram, StackedWeights
from hilsplat.contributions.quadratic_builder import QuadraticBuilder, QuadraticCheckpoint
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps, labelled_rows, view_contributions
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights
from hilsplat.splat.rasterise.device import choose_device

logger = logging.getLogger(__name__)

MATRICES = ("A", "A_half", "S")
PARTS = {"data": np.float32, "indices": np.int32, "indptr": np.int64}

WEIGHTS_PER_PIXEL = 40  # weights per pixel in a typical scene

MAX_WEIGHTS_TOGETHER = 2**25
"""Views with more weights (256 MiB) are prepared one at a time; up to four finished views may be waiting."""


class ArrayStream:
    """An .npy file written row by row, so that the stage never keeps all of its output in memory.

    `row_shape` is the shape of one row: () for an array of numbers.
    """

    def __init__(self, path: Path, dtype: type, row_shape: tuple[int, ...] = ()) -> None:
        self._dtype, self._row_shape, self._rows = np.dtype(dtype), row_shape, 0
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("wb")
        self._write_header()

    def _write_header(self) -> None:
        # the header's size does not depend on the number of rows
        shape = (self._rows, *self._row_shape)
        header = {"descr": self._dtype.str, "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._stream, header)

    def __len__(self) -> int:
        return self._rows

    def append(self, values: np.ndarray) -> None:
        """Add rows."""
        values = np.ascontiguousarray(values, self._dtype)
        self._rows += len(values)
        self._stream.write(values.data)

    def close(self) -> None:
        """Complete the header."""
        self._stream.seek(0)
        self._write_header()
        self._stream.close()


def run_contributions(
    scene_folder: Path,
    gaussians_ply: Path,
    masks_folder: Path,
    out: Path,
    cache: Path,
    settings: ContributionsSettings,
    threads: int,
) -> None:
    """Write A, A_half, S, mass, and G or W, in one pass over the training views.

    One or two views are prepared while rows of previous views are written and added to G. Memory contains
    these views and the sum of G so far. After an interruption, a rerun reads the matrices of finished views
    from the cache, and G from a checkpoint at most `CHECKPOINT_SECONDS` (and one view) old; it rasterises W
    again for views not yet in that G.

    Raises:
        MisalignedArtifactError: masks and images differ in size, or the masks of a view differ from those
            recorded in their index.
        ArtifactError: no training view has masks.
    """
    scene = Scene.load(scene_folder)
    gaussians = load_ply(gaussians_ply)
    gaussians_sha256 = sha256_of_file(gaussians_ply)
    device = choose_device(settings.device)
    digests = digests_in(masks_folder)
    about = {
        "code": code_digest(run_contributions),
        "device": device,
        "gaussians": gaussians_sha256,
        "min_weight": settings.min_weight,
    }
    names = digests if read_index(masks_folder).get("partial") else scene.views("train")
    cameras = [scene.cameras[name] for name in names]
    keys = [
        sha256_of_json(
            {
                **about,
                "masks": digests.get(camera.name),
                "camera": sha256_of_bytes(camera.cam_from_world.tobytes(), camera.K.tobytes()),
                "view": camera.name,
            }
        )
        for camera in cameras
    ]
    # two views are prepared at once if W fits, because half the work uses one thread
    most_px = max((math.prod(camera.size_hw) for camera in cameras), default=0)
    together = min(2, max(1, threads)) if most_px * WEIGHTS_PER_PIXEL <= MAX_WEIGHTS_TOGETHER else 1
    threads_each = max(1, threads // together)
    store = ViewCache(Path(cache) / "contributions", compressed=False)
    checkpoint = QuadraticCheckpoint(store.folder / "partial", keys, settings.keep)
    rows: dict[str, list[np.ndarray]] = {
        name: [] for name in ("view", "mask", "level", "area_px", "pixels", "half_pixels")
    }
    with stage_log("contributions", scene.name) as counts, atomic_folder(out) as folder:
        builder = QuadraticBuilder(len(gaussians), settings.keep, threads)
        summed = checkpoint.resume(builder)
        streams = {
            f"{name}_{what}": ArrayStream(folder / name / f"{what}.npy", dtype)
            for name in MATRICES
            for what, dtype in PARTS.items()
        }
        streams["mass"] = ArrayStream(folder / "mass.npy", np.float32, (len(gaussians),))
        for name in MATRICES:
            streams[f"{name}_indptr"].append(np.zeros(1))

        def prepare(number: int) -> tuple[HierarchicalMasks, dict[str, np.ndarray], StackedWeights | None]:
            """Return the masks and matrices of a view, and its rows of W if they are not yet in G."""
            camera = cameras[number]
            masks = load_masks(masks_folder, camera.name, digests)
            if masks.size_hw != camera.size_hw:
                raise MisalignedArtifactError(
                    f"the masks of view {camera.name} do not match the size of its camera",
                    expected=f"{camera.size_hw[0]} x {camera.size_hw[1]} (height x width)",
                    found=f"{masks.size_hw[0]} x {masks.size_hw[1]}",
                    fix="rerun the masks stage",
                )

            @cache_calls
            def weights() -> sp.csr_matrix:
                least = settings.min_weight
                return normalised_weights(
                    pixel_weights(gaussians, camera, min_weight=least, threads=threads_each, device=device)
                )

            part = store.get(
                keys[number], lambda: view_contributions(camera.name, weights(), masks, threads_each)
            )
            if settings.keep == "none" or number < summed:
                return masks, part, None
            return masks, part, labelled_rows(weights(), label_maps(masks))

        prepared = in_order(prepare, range(len(cameras)), together)
        prepared = track(prepared, "contributions of views", len(cameras))
        for number, (masks, part, labelled) in enumerate(prepared):
            part["mass"] = part["mass"][None]
            for name in MATRICES:
                part[f"{name}_indptr"] = part[f"{name}_indptr"][1:] + len(streams[f"{name}_data"])
            for name, stream in streams.items():
                stream.append(part[name])
            rows["view"].append(np.full(len(masks), number, np.int32))
            rows["mask"].append(np.arange(len(masks), dtype=np.int32))
            rows["level"].append(masks.level)
            rows["area_px"].append(masks.area_px)
            rows["pixels"].append(part["pixels"])
            rows["half_pixels"].append(part["half_pixels"])
            if labelled is not None:
                builder.add(labelled)
                checkpoint.offer(builder, number + 1)
        for stream in streams.values():
            stream.close()
        num_masks = sum(len(part) for part in rows["view"])
        if not num_masks:
            raise ArtifactError(
                f"no training view of {scene.name} has masks",
                fix="loosen masks.predicted_iou_min or masks.stability_min, then rerun the masks stage",
            )
        np.save(folder / "means.npy", gaussians.means)
        np.save(folder / "centres.npy", np.stack([camera.centre for camera in cameras]))
        arrays = {name: np.concatenate(values) for name, values in rows.items()}
        require_types(Contributions, arrays, out / "rows.npz", {})
        write_npz(folder / "rows.npz", **arrays)
        counts |= {"views": len(cameras), "masks": num_masks}
        nonzeros = {name: len(streams[f"{name}_data"]) for name in MATRICES}
        if settings.keep != "none":
            quadratic = builder.finish()
            quadratic.save(folder)
            kept = "G" if isinstance(quadratic, Gram) else "W"
            nonzeros |= {"W": builder.weights_nonzeros, kept: quadratic.nonzeros}
            counts |= {"kept": kept, "nonzeros": quadratic.nonzeros}
        counts["from_cache"] = store.hits
        write_index(
            folder,
            {
                camera.name: {MASKS_SHA256: digests[camera.name], "masks": len(part)}
                for camera, part in zip(cameras, rows["view"], strict=True)
            },
            scene=scene.name,
            num_gaussians=len(gaussians),
            gaussians_sha256=gaussians_sha256,
            cameras_sha256=sha256_of_file(scene_folder / "cameras.npz"),
            min_weight=settings.min_weight,
            num_masks=num_masks,
            nonzeros=nonzeros,
        )
    checkpoint.forget()
