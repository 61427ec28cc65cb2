"""The pipeline from Python: photographs, a posed scene, Gaussians, masks, and a tree that accepts queries.

Each function runs what its stage runs (`stages.py`), with the same bytes for the same settings and seed, and
returns objects. Files are temporary unless a folder is given. Further keyword arguments are settings of the
stage's section with their defaults (`hilsplat settings`); SettingsError is raised if one is unknown or
invalid. `threads` does not affect results; None uses all cores. With `progress`, loops and stages are
reported on stderr.
"""

import logging
import os
import weakref
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from threadpoolctl import OpenBLASController, ThreadpoolController

from hilsplat import settings as of
from hilsplat import stages
from hilsplat.base.artifacts import INDEX, read_memo
from hilsplat.base.cache import ViewCache
from hilsplat.base.errors import (
    ArtifactError,
    MisalignedArtifactError,
    SceneError,
    SettingsError,
    require_kind,
    shorten_list,
)
from hilsplat.base.levels import LEVELS
from hilsplat.base.processes import Shared, num_cores
from hilsplat.base.progress import reporting, track
from hilsplat.base.removal import delete
from hilsplat.configuration import resolve_auto, validated
from hilsplat.models.store import AUTO
from hilsplat.photos.intake import prepared_photographs
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.finished import FinishedScene, SceneParts, require_scene_folder
from hilsplat.scene.layouts import NO_POSES, has_known_poses
from hilsplat.scene.scene import Scene
from hilsplat.scene.sheet import PHOTOS
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.segment.stage import segment_views, train_views, write_masks
from hilsplat.splat.coordinates import import_gaussians, write_coordinates
from hilsplat.splat.fit import fit_gaussians
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply, save_ply

FRAMES = 60  # maximum number of frames of videos, as in `hilsplat new`
OPEN = "open it: hilsplat.load_scene(...)"
GIVEN = "given"  # kind of Gaussians that `link` stored, in the JSON file beside the PLY

logger = logging.getLogger(__name__)


class SceneMasks(dict[str, HierarchicalMasks]):
    """Masks of a scene's training views, by view; `dense()` of a view's masks returns them as (M, H, W) bool.

    `origin` has segmenter and model, as recorded in the index of a `masks` artifact.
    """

    def __init__(self, of_views: Mapping[str, HierarchicalMasks], origin: Mapping[str, Any]) -> None:
        super().__init__(of_views)
        self.origin = dict(origin)

    def __repr__(self) -> str:
        counts = {level: sum(len(masks.rows_of(level)) for masks in self.values()) for level in LEVELS}
        named = ", ".join(f"{count} {level.label}" for level, count in counts.items())
        return f"SceneMasks({len(self)} views: {named})"


def reconstruct(
    photos: Path | str,
    *,
    folder: Path | str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> Scene:
    """Compute the camera poses and sparse points of photographs by structure from motion.

    Args:
        photos: a folder of photographs or of videos, a video, or a zip of photographs; poses in the folder
            are ignored (see `load_scene`). Up to 60 frames of videos are used.
        folder: folder of a results scene, such as results/photos/desk, in which `scene/` and the frames of
            videos are stored. By default, they are deleted with the returned object.
        settings: those of section `poses`, such as `max_side_px=800`.

    Raises:
        SceneError, ImageError: the photographs cannot be used.
        RegistrationError: too few photographs could be registered.
        ArtifactError: the folder has results of a run.
    """
    return _posed(_path(photos), NO_POSES, settings, folder, seed, threads, progress)


def load_scene(
    path: Path | str,
    *,
    poses: Path | str | None = None,
    folder: Path | str | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> Scene:
    """Open the posed scene of a results folder, or import images with known poses.

    Args:
        path: results/<dataset>/<scene>; or a folder (or zip) that has poses of COLMAP (`sparse/`),
            nerfstudio (`transforms.json`), LLFF, Polycam or Record3D.
        poses: a COLMAP model or transforms.json to use instead of the poses in the folder.
        folder, settings: for an import, as in `reconstruct`.
        seed: for an import without sparse points, which are then triangulated.

    Raises:
        ArtifactError: the path does not exist; the message lists the scenes of its results folder.
        SceneError: the folder has no poses, or they cannot be used.
    """
    path = _path(path).absolute()  # files are read later, perhaps from another working folder
    for posed in (path / "scene", path):
        if (posed / INDEX).is_file() and (posed / "cameras.npz").is_file():
            if settings or poses or folder:
                raise SettingsError(
                    f"{posed} is posed already: settings, poses and folder are for imports",
                    fix="omit them, or import the scene's source again",
                )
            return Scene.load(posed)
    if not path.is_file():
        require_scene_folder(path)
    return _posed(path, _path(poses) if poses else None, settings, folder, seed, threads, progress)


def _posed(
    source: Path,
    poses: Path | None,
    settings: Mapping[str, Any],
    folder: Path | str | None,
    seed: int,
    threads: int | None,
    progress: bool,
) -> Scene:
    """Run the stage `poses`; without a folder, the scene's files are deleted with the returned object."""
    source, section = source.resolve(), validated("poses", settings)
    _require_seed(seed)
    _require_own(folder)
    with ExitStack() as files:
        base = files.enter_context(_folder(folder))
        with _running(progress), prepared_photographs(source, base / "source", FRAMES) as (images, _):
            if poses is None and not has_known_poses(images):
                raise SceneError(
                    f"{source} has no known poses",
                    expected="poses of COLMAP, nerfstudio, LLFF, Polycam or Record3D",
                    fix="compute poses: hilsplat.reconstruct(...), or pass poses=",
                )
            name, out = f"{PHOTOS}/{base.name if folder else source.stem}", base / "scene"
            stages.poses(images, out, section, name=name, poses=poses, seed=seed, threads=_threads(threads))
        scene = Scene.load(out)
        weakref.finalize(scene, files.pop_all().close)
    return scene


def fit(
    scene: Scene,
    iterations: int | None = None,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> Gaussians:
    """Fit 3D Gaussians to a scene's training views.

    Args:
        iterations: number of steps; by default as in the stage, 60 per view, but at least 1500 and at most
            3000 (`gaussians.steps_per_view` and `gaussians.iterations`).
        settings: those of section `gaussians`, such as `max_gaussians=20000`.

    Raises:
        SettingsError: a setting or the seed is invalid.
        SceneError: the scene has no training views, or all Gaussians became transparent.
        DeviceError: `device="cuda"` cannot be used.
    """
    require_kind(scene, Scene, OPEN)
    _require_seed(seed)
    steps = {} if iterations is None else {"iterations": iterations, "steps_per_view": iterations}
    section = validated("gaussians", steps | settings)
    with _running(progress):
        return fit_gaussians(scene, section, seed=seed, threads=_threads(threads))[0]


def load_gaussians(path: Path | str, scene: Scene | None = None) -> Gaussians:
    """Read a 3DGS PLY.

    Args:
        scene: scene to whose coordinates the Gaussians are moved: from those of its source, in which 3DGS
            trained, or those that the PLY's header or the JSON file beside it describes. None for a PLY that
            hilsplat wrote, such as results/photos/desk/gaussians.ply, which is read as it is.

    Raises:
        ArtifactError: the file is missing, or is not a 3DGS PLY.
    """
    if scene is None:
        return load_ply(_path(path))
    require_kind(scene, Scene, OPEN)
    return import_gaussians(_path(path), scene)[0]


def segment(
    scene: Scene,
    model: str = AUTO,
    *,
    cache: Path | str | None = None,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> SceneMasks:
    """Segment a scene's training views at three levels.

    Args:
        model: folder of a SAM model; "auto" uses the best pretrained SAM that is installed, or else the graph
            segmenter, which needs no model.
        cache: folder that keeps finished views, such as results/.cache, so that a repeated or interrupted
            call only computes the rest; by default, a temporary folder.
        settings: those of section `masks`, such as `points_per_side=16` or `segmenter="graph"`.

    Raises:
        SceneError: the scene has no training views.
        ModelError: the model is missing or incomplete.
    """
    require_kind(scene, Scene, OPEN)
    segmenter = AUTO if model == AUTO else "sam"
    chosen = validated("masks", {"segmenter": segmenter, "model": str(model), **settings})
    section, views = resolve_auto(chosen), train_views(scene)
    with _running(progress), _folder(cache) as folder:
        views_and_masks, origin = segment_views(
            scene, views, ViewCache(folder / "masks"), section, _threads(threads)
        )
        return SceneMasks(dict(track(views_and_masks, "masks of views", len(views))), origin)


def link(
    scene: Scene,
    gaussians: Gaussians,
    masks: SceneMasks,
    *,
    model: str = AUTO,
    folder: Path | str | None = None,
    cache: Path | str | None = None,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> LanguageScene:
    """Link the masks of all views into a tree of nodes that accepts queries.

    This runs the stages contributions, semantic_tree, clip and names.

    Args:
        gaussians: in the scene's coordinates.
        model: folder of a CLIP model; "auto" uses the best pretrained one that is installed, or else
            models/clip-tiny, whose answers about photographs are meaningless.
        folder: the folder given to `reconstruct` or `load_scene`, in which all results are then stored, in
            place of those of an earlier call; `open_scene`, `show` and `hilsplat view` open it. By default,
            nothing is stored.
        cache: as in `segment`.
        settings: those of section `semantic_tree`, such as `min_views=2`.

    Raises:
        ArtifactError: the folder has results of a run or another scene.
        SceneError: there are no Gaussians.
        MisalignedArtifactError: there are no masks, or some are not those of the scene's training views.
        ModelError: the model is missing or incomplete.
    """
    require_kind(scene, Scene, OPEN)
    require_kind(gaussians, Gaussians, "pass those of hilsplat.fit or load_gaussians")
    section, number = validated("semantic_tree", settings), _threads(threads)
    clip = resolve_auto(validated("clip", {"model": str(model), "crops": "nodes"}))
    views = train_views(scene)
    if not (isinstance(masks, SceneMasks) and masks and set(masks) <= set(views)):
        raise MisalignedArtifactError(
            f"the masks are not those of the training views of {scene.name}",
            expected=f"SceneMasks of {shorten_list(views)}",
            found=f"{type(masks).__name__} of {shorten_list([*masks]) or 'no views'}",
            fix="pass the result of hilsplat.segment for this scene",
        )
    if not len(gaussians):
        raise SceneError("there are no Gaussians to link", fix="pass those of hilsplat.fit or load_gaussians")
    _require_own(folder)
    if folder and scene.folder.resolve() != (_path(folder) / "scene").resolve():
        raise ArtifactError(
            f"{folder} is not the folder of {scene.name}, whose poses are in {scene.folder}",
            fix="give the same folder to `reconstruct` or `load_scene`, and to `link`",
        )
    with _running(progress), _folder(cache) as cached, _folder(folder) as base:
        out, ply = base / "default", base / "gaussians.ply"
        parts = SceneParts(scene.folder, ply, out / "semantic_tree", None, None, out / "clip", out / "masks")
        save_ply(ply, gaussians)
        write_coordinates(ply, scene, gaussians, {"kind": GIVEN})
        write_masks(parts.masks, scene, masks.items(), len(masks), **masks.origin)
        contributions = out / "contributions"
        weights = of.ContributionsSettings(keep="none")
        stages.contributions(scene.folder, ply, parts.masks, contributions, weights, cached, number)
        stages.semantic_tree(contributions, parts.masks, parts.semantic_tree, section, number)
        stages.clip(scene.folder, parts.masks, parts.clip, clip, parts.semantic_tree, cached, number)
        naming = of.QuerySettings(), of.EvaluateSettings(), cached
        stages.names(parts.semantic_tree, parts.clip, out / "names", *naming)
        linked = LanguageScene.of(FinishedScene(base, "default", parts), threads=number)
    if linked.caution:
        logger.warning("%s: %s", scene.name, linked.caution)
    # The views keep the given scene, whose temporary files are deleted with it.
    return replace(linked, views=replace(linked.views, scene=scene, gaussians=gaussians))


def _require_own(folder: Path | str | None) -> None:
    """Raise ArtifactError if a folder has Gaussians or variants that `link` did not store."""
    names = ("gaussians.ply", "default") if folder else ()
    base = _path(folder or "")
    origin = read_memo(base / "gaussians.json", dict[str, Any]).get("origin")
    if any((base / name).exists() for name in names) and origin != {"kind": GIVEN}:
        raise ArtifactError(
            f"{folder} has results of a run",
            expected="a new folder, or one with results of `hilsplat.link`",
            fix="choose another folder, or open this scene: hilsplat.open_scene(...)",
        )


@contextmanager
def _running(progress: bool) -> Iterator[None]:
    """Report progress, and sum in linear algebra libraries in one thread, as commands do for equal bytes."""
    openmp = ThreadpoolController().select(user_api="openmp").limit(limits=1)  # of this thread only
    with reporting(progress), openmp, _ONE_BLAS_THREAD:
        yield


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    release = partial(OpenBLASController.clear_controlling_thread, force=True)
    release()  # threadpoolctl ignores limits from other threads than the first one that set a limit
    limit = ThreadpoolController().select(user_api="blas").limit(limits=1)
    try:
        yield
    finally:
        release()
        limit.restore_original_limits()
        release()


_ONE_BLAS_THREAD = Shared(_one_blas_thread)


def _path(path: Path | str) -> Path:
    """Return a path in which a leading `~` is replaced by the home folder."""
    return Path(path).expanduser()


@contextmanager
def _folder(path: Path | str | None) -> Iterator[Path]:
    """Yield the folder, or a temporary one, which only the process that created it deletes."""
    if path:
        yield _path(path).absolute()
        return
    folder, creator = Path(mkdtemp(prefix="hilsplat-")).absolute(), os.getpid()
    try:
        yield folder
    finally:
        if os.getpid() == creator:  # a forked process also has the object
            delete(folder, "hilsplat-.+")


def _require_seed(seed: int) -> None:
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise SettingsError(f"seed is {seed!r}", expected="a whole number, at least 0")


def _threads(number: int | None) -> int:
    return number or num_cores()
