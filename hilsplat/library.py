"""The pipeline from Python: photographs, a posed scene, Gaussians, masks, and a tree that accepts queries.

Each function runs what its stage runs (`stages.py`), with the same bytes for the same settings and seed, and
returns objects. Files are temporary unless a folder is given. Further keyword arguments are settings of the
stage's section with their defaults (`hilsplat settings`). `threads` does not affect results; None uses all
cores. With `progress`, loops and stages are reported on stderr.
"""

import logging
import os
import shutil
import weakref
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32
from pydantic import ValidationError
from threadpoolctl import threadpool_limits

from hilsplat import settings as of
from hilsplat import stages
from hilsplat.base.artifacts import INDEX, provenance_path
from hilsplat.base.atomic import atomic_folder
from hilsplat.base.cache import ViewCache
from hilsplat.base.errors import ArtifactError, SceneError, SettingsError
from hilsplat.base.levels import LEVELS
from hilsplat.base.progress import reporting, track
from hilsplat.configuration import resolve_auto, settings_error
from hilsplat.models.store import AUTO
from hilsplat.photos.intake import prepared_photographs
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Camera
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
from hilsplat.splat.rasterise.api import Rendering, rendering

Section = TypeVar("Section", bound=of.Section)

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SceneMasks(Mapping[str, HierarchicalMasks]):
    """Masks of a scene's training views, by view.

    Attributes:
        of_view: masks of each view; `dense()` returns them as (M, H, W) bool.
        origin: segmenter and model, as recorded in the index of a `masks` artifact.
    """

    of_view: dict[str, HierarchicalMasks]
    origin: dict[str, Any]

    def __getitem__(self, view: str) -> HierarchicalMasks:
        return self.of_view[view]

    def __iter__(self) -> Iterator[str]:
        return iter(self.of_view)

    def __len__(self) -> int:
        return len(self.of_view)

    def __repr__(self) -> str:
        counts = {level: sum(len(masks.rows_of(level)) for masks in self.values()) for level in LEVELS}
        named = ", ".join(f"{count} {level.label}" for level, count in counts.items())
        return f"SceneMasks({len(self)} views: {named})"


def reconstruct(
    photos: Path | str,
    *,
    name: str = "",
    folder: Path | str | None = None,
    frames: int = 60,
    seed: int = 0,
    threads: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> Scene:
    """Compute the camera poses and sparse points of photographs by structure from motion.

    Args:
        photos: a folder of photographs or of videos, a video, or a zip of photographs; poses in the folder
            are ignored (see `load_scene`).
        name: name of the scene in messages, as dataset/scene; by default, photos/<name of `photos`>.
        folder: folder of a results scene, such as results/photos/desk, in which `scene/` and the frames of
            videos are stored. By default, they are deleted with the returned object.
        frames: maximum number of frames of videos.
        settings: those of section `poses`, such as `max_side_px=800`.

    Raises:
        SceneError, ImageError: the photographs cannot be used.
        RegistrationError: too few photographs could be registered.
        SettingsError: a setting is unknown or invalid.
    """
    return _posed(
        Path(photos),
        _section(of.PosesSettings, settings),
        poses=NO_POSES,
        frames=frames,
        name=name,
        folder=folder,
        seed=seed,
        threads=threads,
        progress=progress,
    )


def load_scene(
    path: Path | str,
    *,
    poses: Path | str | None = None,
    name: str = "",
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
        name, folder, settings: for an import, as in `reconstruct`.
        seed: for an import without sparse points, which are then triangulated.

    Raises:
        ArtifactError: the path does not exist; the message lists the scenes of its results folder.
        SceneError: the folder has no poses, or they cannot be used.
        SettingsError: a setting is unknown or invalid, or the scene is already posed.
    """
    path = Path(path)
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
    return _posed(
        path,
        _section(of.PosesSettings, settings),
        poses=None if poses is None else Path(poses),
        frames=1,  # a video has no poses
        name=name,
        folder=folder,
        seed=seed,
        threads=threads,
        progress=progress,
    )


def _posed(
    source: Path,
    section: of.PosesSettings,
    *,
    poses: Path | None,
    frames: int,
    name: str,
    folder: Path | str | None,
    seed: int,
    threads: int | None,
    progress: bool,
) -> Scene:
    """Run the stage `poses`; without a folder, the scene's files are deleted with the returned object."""
    source = source.resolve()
    with ExitStack() as files:
        base = Path(folder or files.enter_context(TemporaryDirectory(prefix="hilsplat-")))
        with _running(progress), prepared_photographs(source, base / "source", frames) as (images, _):
            if poses is None and not has_known_poses(images):
                raise SceneError(
                    f"{source} has no known poses",
                    expected="poses of COLMAP, nerfstudio, LLFF, Polycam or Record3D",
                    fix="compute poses: hilsplat.reconstruct(...), or pass poses=",
                )
            name, number = name or f"{PHOTOS}/{source.stem}", _threads(threads)
            out = base / "scene"
            stages.poses(images, out, section, name=name, poses=poses, seed=seed, threads=number)
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
        SceneError: the scene has no training views, or all Gaussians became transparent.
        DeviceError: `device="cuda"` cannot be used.
        SettingsError: a setting is unknown or invalid.
    """
    steps = {} if iterations is None else {"iterations": iterations, "steps_per_view": iterations}
    section = _section(of.GaussiansSettings, steps | settings)
    with _running(progress):
        return fit_gaussians(scene, section, seed=seed, threads=_threads(threads))[0]


def load_gaussians(path: Path | str, scene: Scene | None = None) -> Gaussians:
    """Read a 3DGS PLY.

    Args:
        scene: scene to whose coordinates the Gaussians are moved: from those of its source, in which 3DGS
            trained, or those that the JSON file beside the PLY describes. None for a PLY that hilsplat wrote,
            such as results/photos/desk/gaussians.ply, which is read as it is.

    Raises:
        ArtifactError: the file is missing, or is not a 3DGS PLY.
    """
    return load_ply(Path(path)) if scene is None else import_gaussians(Path(path), scene)[0]


def render(
    gaussians: Gaussians,
    camera: Camera,
    features: Float32[np.ndarray, "N D"] | None = None,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    threads: int | None = None,
) -> Rendering:
    """Render colours, depth, features and alpha of a view on the CPU.

    Args:
        camera: such as `scene.cameras[0]`, `scene.cameras["000.png"]`, or one of these `.scaled((H, W))`.
        features: D values per Gaussian, blended like its colours.

    Raises:
        HilsplatError: Gaussians have non-finite parameters.
    """
    return rendering(gaussians, camera, features, background=background, threads=_threads(threads))


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
        SettingsError: a setting is unknown or invalid.
    """
    segmenter = AUTO if model == AUTO else "sam"
    chosen = _section(of.MasksSettings, {"segmenter": segmenter, "model": str(model), **settings})
    section, views = resolve_auto(chosen), train_views(scene)
    with _running(progress), _cache_folder(cache) as folder:
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
        folder: folder of a results scene to write, such as results/photos/desk, which `open_scene`, `show`
            and `hilsplat view` open; it must not have Gaussians or variants yet. None writes nothing.
        cache: as in `segment`.
        settings: those of section `semantic_tree`, such as `min_views=2`.

    Raises:
        ArtifactError: the masks are empty, or the folder has results.
        MisalignedArtifactError: the masks are not those of the scene's training views.
        ModelError: the model is missing or incomplete.
        SettingsError: a setting is unknown or invalid.
    """
    section, number = _section(of.SemanticTreeSettings, settings), _threads(threads)
    clip = resolve_auto(_section(of.ClipSettings, {"model": str(model), "crops": "nodes"}))
    evaluate = of.EvaluateSettings()
    with _running(progress), _cache_folder(cache) as cached, _results(folder, scene) as base:
        own, ply = base / "default", base / "gaussians.ply"
        parts = SceneParts(scene.folder, ply, own / "semantic_tree", None, None, own / "clip", own / "masks")
        save_ply(ply, gaussians)
        write_coordinates(ply, scene, gaussians, {"kind": "given"})
        write_masks(parts.masks, scene, masks.items(), len(masks), **masks.origin)
        contributions = own / "contributions"
        weights = of.ContributionsSettings(keep="none")
        stages.contributions(scene.folder, ply, parts.masks, contributions, weights, cached, number)
        stages.semantic_tree(contributions, parts.masks, parts.semantic_tree, section, number)
        stages.clip(scene.folder, parts.masks, parts.clip, clip, parts.semantic_tree, cached, number)
        names = own / "names"
        stages.names(parts.semantic_tree, parts.clip, names, of.QuerySettings(), evaluate, cached)
        linked = LanguageScene.of(FinishedScene(base, "default", parts), threads=number)
    # The views must keep the given scene, whose temporary files are deleted with it.
    if linked.caution:
        logger.warning("%s: %s", scene.name, linked.caution)
    return replace(linked, views=replace(linked.views, scene=scene, gaussians=gaussians))


@contextmanager
def _results(folder: Path | str | None, scene: Scene) -> Iterator[Path]:
    """Yield a temporary folder for a results scene, or the given one, with a copy of the posed scene."""
    if folder is None:
        with TemporaryDirectory(prefix="hilsplat-") as temporary:
            yield Path(temporary)
        return
    base = Path(folder)
    posed, is_own = base / "scene", scene.folder.resolve() == (base / "scene").resolve()
    for path in (base / "gaussians.ply", base / "default", *([] if is_own else [posed])):
        if path.exists():
            raise ArtifactError(
                f"{path} already exists",
                expected="a new folder, or the folder given to `reconstruct` or `load_scene`",
                fix="choose another folder, or open the scene: hilsplat.open_scene(...)",
            )
    if not is_own:
        with atomic_folder(posed) as copy:
            shutil.copytree(scene.folder, copy, dirs_exist_ok=True)
        if (record := provenance_path(scene.folder)).is_file():
            shutil.copyfile(record, provenance_path(posed))
    yield base


def _section(kind: type[Section], values: Mapping[str, Any]) -> Section:
    """Return a section of the settings; raise SettingsError if a name is unknown or a value invalid."""
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise settings_error(error, "", kind) from error


@contextmanager
def _running(progress: bool) -> Iterator[None]:
    """Report progress, and sum in linear algebra libraries in one thread, as commands do for equal bytes."""
    with reporting(progress), threadpool_limits(1):
        yield


@contextmanager
def _cache_folder(cache: Path | str | None) -> Iterator[Path]:
    if cache is not None:
        yield Path(cache)
        return
    with TemporaryDirectory(prefix="hilsplat-") as temporary:
        yield Path(temporary)


def _threads(number: int | None) -> int:
    return number or os.cpu_count() or 1
