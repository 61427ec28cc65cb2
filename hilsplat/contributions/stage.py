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

import math
from collections.abc import Callable
from functools import cache as cache_calls
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from hilsplat.base.arrays import Scratch, require_types
from hilsplat.base.artifacts import read_index, write_index, write_npz
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.code import code_digest
from hilsplat.base.errors import ArtifactError
from hilsplat.base.lineage import require_size, sha256_of_bytes, sha256_of_file, sha256_of_json
from hilsplat.base.memory import MIB, limit_mib, require_memory
from hilsplat.base.processes import in_order
from hilsplat.base.progress import stage_log, track
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.contributions.quadratic import Gram, StackedWeights
from hilsplat.contributions.quadratic_builder import QuadraticBuilder, QuadraticCheckpoint
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import label_maps, labelled_rows, view_contributions
from hilsplat.scene.cameras import Camera
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import MASKS_SHA256, digests_in, load_masks
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ContributionsSettings
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights
from hilsplat.splat.rasterise.device import choose_device, explained_memory

MATRICES = ("A", "A_half", "S", "mass")
PARTS = {"data": np.float32, "indices": np.int32, "indptr": np.int64}

WEIGHTS_PER_PIXEL = 40  # weights per pixel in a typical scene

BASE_MIB, WEIGHT_BYTES, GAUSSIAN_BYTES = 350, 24, 200
"""Memory of the stage without G and W of all views: of libraries, per weight of a view, and per Gaussian."""

IN_MEMORY = 2**20  # G and W of more Gaussians are summed in files

MAX_WEIGHTS_TOGETHER = 2**25
"""Views with more weights (256 MiB), and views on a card, are prepared one at a time; up to four finished
views may be waiting."""


class ArrayStream:
    """An .npy file of numbers that grows, so that the stage never keeps all of its output in memory."""

    def __init__(self, path: Path, dtype: type) -> None:
        self._dtype, self._length = np.dtype(dtype), 0
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream = path.open("wb")
        self._write_header()

    def _write_header(self) -> None:
        # the header's size does not depend on the length
        header = {"descr": self._dtype.str, "fortran_order": False, "shape": (self._length,)}
        np.lib.format.write_array_header_1_0(self._stream, header)

    def __len__(self) -> int:
        return self._length

    def append(self, values: np.ndarray) -> None:
        values = np.ascontiguousarray(values, self._dtype)
        self._length += len(values)
        self._stream.write(values.data)

    def close(self) -> None:
        self._stream.seek(0)
        self._write_header()
        self._stream.close()


class Output:
    """The stage's files: matrices are written view by view, and one row per mask at the end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: dict[str, list[np.ndarray]] = {}
        self._streams = {
            f"{name}_{part}": ArrayStream(folder / name / f"{part}.npy", dtype)
            for name in MATRICES
            for part, dtype in PARTS.items()
        }
        for name in MATRICES:
            self._streams[f"{name}_indptr"].append(np.zeros(1))

    def append(self, number: int, masks: HierarchicalMasks, matrices: dict[str, np.ndarray]) -> None:
        """Add the matrices of view `number` (see `view_contributions`)."""
        values = dict(matrices)
        for name in MATRICES:
            values[f"{name}_indptr"] = matrices[f"{name}_indptr"][1:] + len(self._streams[f"{name}_data"])
        for name, stream in self._streams.items():
            stream.append(values[name])
        rows = {
            "view": np.full(len(masks), number, np.int32),
            "mask": np.arange(len(masks), dtype=np.int32),
            "level": masks.level,
            "area_px": masks.area_px,
            "pixels": matrices["pixels"],
            "half_pixels": matrices["half_pixels"],
        }
        for name, column in rows.items():
            self._rows.setdefault(name, []).append(column)

    @property
    def masks_per_view(self) -> list[int]:
        return [len(column) for column in self._rows.get("view", [])]

    @property
    def nonzeros(self) -> dict[str, int]:
        return {name: len(self._streams[f"{name}_data"]) for name in MATRICES}

    def finish(self, out: Path) -> None:
        """Complete the matrices and write the rows; `out` names them in errors."""
        for stream in self._streams.values():
            stream.close()
        arrays = {name: np.concatenate(columns) for name, columns in self._rows.items()}
        require_types(Contributions, arrays, out / "rows.npz", {})
        write_npz(self._folder / "rows.npz", **arrays)


def drawn_weights(gaussians: Gaussians, camera: Camera, *, min_weight: float, threads: int) -> sp.csr_matrix:
    return normalised_weights(pixel_weights(gaussians, camera, min_weight=min_weight, threads=threads))


@explained_memory(
    "a view's contributions",
    "lower poses.max_side_px, end other programs that use the card, or set contributions.device: cpu",
)
def run_contributions(
    scene_folder: Path,
    gaussians_ply: Path,
    masks_folder: Path,
    out: Path,
    cache: Path,
    settings: ContributionsSettings,
    threads: int,
    memory_mib: float | None = None,
) -> None:
    """Write A, A_half, S, mass, and G or W, in one pass over the training views.

    One view, or two on the CPU, are prepared while rows of previous views are written and added to G. Memory
    contains these views and the sums so far; sums that don't fit into `memory_mib` are in files. After an
    interruption, a rerun reads the matrices of finished views from the cache, and G from a checkpoint at most
    `CHECKPOINT_SECONDS` (and one view) old; it rasterises W again for views not yet in that G.

    Raises:
        MisalignedArtifactError: masks and images differ in size, or the masks of a view differ from those
            recorded in their index.
        ArtifactError: no training view has masks.
        MemoryLimitError: one view needs more than `memory_mib`, or more than this machine has.
        DeviceError: `settings.device` is `cuda` and cannot be used, or the card's memory runs out.
    """
    scene, gaussians = Scene.load(scene_folder), load_ply(gaussians_ply)
    gaussians_sha256, digests = sha256_of_file(gaussians_ply), digests_in(masks_folder)
    names = digests if read_index(masks_folder).get("partial") else scene.views("train")
    cameras = [scene.cameras[name] for name in names]
    device, code = choose_device(settings.rasteriser), code_digest(run_contributions)
    inputs = {
        "code": code,
        "device": device,
        "gaussians": gaussians_sha256,
        "min_weight": settings.min_weight,
    }
    poses = [sha256_of_bytes(camera.cam_from_world.tobytes(), camera.K.tobytes()) for camera in cameras]
    keys = [
        sha256_of_json({**inputs, "masks": digests.get(camera.name), "camera": pose, "view": camera.name})
        for camera, pose in zip(cameras, poses, strict=True)
    ]
    fixed_mib = BASE_MIB + GAUSSIAN_BYTES * len(gaussians) / MIB
    weights_of_view = WEIGHTS_PER_PIXEL * max((math.prod(camera.size_hw) for camera in cameras), default=0)
    view_mib = WEIGHT_BYTES * weights_of_view / MIB
    require_memory(
        fixed_mib + view_mib,
        memory_mib,
        f"contributions of {len(gaussians):,} Gaussians in a view of {scene.name}",
        "lower poses.max_side_px or gaussians.max_gaussians",
    )
    # half the work on a view uses one thread; a card has memory for one view
    is_small = weights_of_view <= MAX_WEIGHTS_TOGETHER and device == "cpu"
    together = min(2, max(1, threads)) if is_small else 1
    if fixed_mib + together * view_mib > limit_mib(memory_mib):
        together = 1
    sums_mib = limit_mib(memory_mib) - fixed_mib - together * view_mib
    threads_each = max(1, threads // together)
    store = ViewCache(Path(cache) / "contributions", compressed=False)
    checkpoint = QuadraticCheckpoint(store.folder / "partial", keys, settings.keep)

    if device == "cuda":
        from hilsplat.contributions import device as card
        from hilsplat.splat.rasterise.cuda import on_device

        g = on_device(gaussians)
        draw: Callable[[Camera], Any] = partial(card.drawn_weights, g, min_weight=settings.min_weight)
        contributions: Callable[..., dict[str, np.ndarray]] = card.view_contributions
    else:
        draw = partial(drawn_weights, gaussians, min_weight=settings.min_weight, threads=threads_each)
        contributions = partial(view_contributions, threads=threads_each)

    def prepare(number: int) -> tuple[HierarchicalMasks, dict[str, np.ndarray], StackedWeights | None]:
        """Return the masks and matrices of a view, and its rows of W if they are not yet in G."""
        camera = cameras[number]
        masks = load_masks(masks_folder, camera.name, digests)
        problem = f"the masks of view {camera.name} do not match the size of its camera"
        require_size(problem, masks.size_hw, camera.size_hw, fix="rerun the masks stage")

        @cache_calls
        def weights() -> Any:  # on the device
            return draw(camera)

        matrices = store.get(keys[number], lambda: contributions(camera.name, weights(), masks))
        if settings.keep == "none" or number < summed:
            return masks, matrices, None
        W = weights() if device == "cpu" else weights().on_host()
        return masks, matrices, labelled_rows(W, label_maps(masks))

    with stage_log("contributions", scene.name) as counts, atomic_folder(out) as folder:
        sums = Scratch(folder, sums_mib * MIB if len(gaussians) <= IN_MEMORY else 0.0)
        builder = QuadraticBuilder(len(gaussians), settings.keep, len(cameras), threads, sums)
        summed = checkpoint.resume(builder)
        output = Output(folder)
        prepared = in_order(prepare, range(len(cameras)), together)
        prepared = track(prepared, "contributions of views", len(cameras))
        for number, (masks, matrices, labelled) in enumerate(prepared):
            output.append(number, masks, matrices)
            if labelled is not None:
                builder.add(labelled)
                checkpoint.offer(builder, number + 1)
        num_masks = sum(output.masks_per_view)
        if not num_masks:
            raise ArtifactError(
                f"no training view of {scene.name} has masks",
                fix="loosen masks.predicted_iou_min or masks.stability_min, then rerun the masks stage",
            )
        output.finish(out)
        np.save(folder / "means.npy", gaussians.means)
        np.save(folder / "centres.npy", np.stack([camera.centre for camera in cameras]))
        counts |= {"views": len(cameras), "masks": num_masks}
        nonzeros = output.nonzeros
        if settings.keep != "none":
            quadratic = builder.finish()
            quadratic.save(folder)
            matrix = "G" if isinstance(quadratic, Gram) else "W"
            nonzeros |= {"W": builder.weights_nonzeros, matrix: quadratic.nonzeros}
            counts |= {"kept": matrix, "nonzeros": quadratic.nonzeros}
        counts["from_cache"] = store.hits
        write_index(
            folder,
            {
                camera.name: {MASKS_SHA256: digests[camera.name], "masks": count}
                for camera, count in zip(cameras, output.masks_per_view, strict=True)
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
