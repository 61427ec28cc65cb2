"""What a scene's folder offers besides photographs: what will be used, what is left out, and why."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

from hilsplat.base.errors import (
    HilsplatError,
    ImageError,
    MisalignedArtifactError,
    SceneError,
    in_one_line,
    shorten_list,
)
from hilsplat.base.files import list_images
from hilsplat.base.images import image_size_hw, read_image, to_uint8
from hilsplat.base.lineage import visible_files
from hilsplat.configuration import StageSettings
from hilsplat.datasets.images.hi import annotated_regions
from hilsplat.datasets.labelled import LabelledRegion
from hilsplat.embed.clip import ClipModel
from hilsplat.embed.langsplat_files import read_view, read_views, require_model
from hilsplat.scene import layouts
from hilsplat.scene.assemble import photo_of, pinhole_of
from hilsplat.scene.cameras import Camera
from hilsplat.scene.colmap import is_pinhole
from hilsplat.scene.importers.importing import fitted_camera, misfit_notes
from hilsplat.scene.importers.known_views import KnownView
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.placement import of_view, placement
from hilsplat.scene.view_names import match_names, view_names
from hilsplat.splat.coordinates import read_gaussians, source_from_ply
from hilsplat.splat.gaussians import base_rgb

MAX_UNDISTORTION = 0.1
"""Relative change of the aspect ratio by undistortion, above which a drawing is of another picture. It is a
few percent; 4:3 and 3:2 differ by 12 %."""


UNREAD_POSES = (
    *("*.xml", "cameras.json", "*.nvm", "*.out", "*.sfm", "*.xmp", "*.csv", "sfm_data*.json"),
    *("meta_data.json", "reconstruction.json", "cameras*.npz", "traj*.txt", "groundtruth.txt", "*.sens"),
)
"""Poses that Metashape, 3DGS, VisualSFM, Bundler, Meshroom, RealityCapture, OpenMVG, SDFStudio, OpenSfM and
NeuS write, and those of Replica, TUM and ScanNet."""


@dataclass
class Parts:
    """What is used with a folder of photographs.

    Attributes:
        files: all files in the folder.
        columns: paths for the scene sheet, by column.
        posed: images with known poses.
        labels: label files to copy, and the names of the copies, which are those of the views.
        lines: what was found, used and left out, for the user.
    """

    files: list[Path]
    columns: dict[str, Path] = field(default_factory=dict)
    posed: list[Path] = field(default_factory=list)
    labels: dict[Path, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


@dataclass
class Views:
    """The views to be expected.

    Attributes:
        photos: photographs, by view.
        cameras: cameras after undistortion, by view; empty if the poses are unknown.
        held_out: views that the source of the poses holds out.
        posed: the views as their source describes them, with their images as stored.
    """

    photos: dict[str, Path] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    held_out: set[str] = field(default_factory=set)
    posed: list[KnownView] = field(default_factory=list)


def find_parts(folder: Path, named: dict[str, Path | None], settings: StageSettings) -> Parts:
    """Find poses, Gaussians, features and labels: those that the user named, or else those in the folder.

    Without known poses, the coordinates of another program's Gaussians are unknown, so these are ignored.

    Raises:
        SceneError: a path is missing, or most views, labels or Gaussians cannot be used.
    """
    for what, path in named.items():
        if path is not None and path != layouts.NO_POSES and not path.exists():
            raise SceneError(f"--{what} {path} is missing", fix="correct the path, or pass `none`")
    parts = Parts(visible_files(folder))
    views = _poses(folder, named["poses"], settings, parts)
    _gaussians(folder, named, views, parts)
    _features(folder, named["features"], views, settings, parts)
    _labels(folder, named["labels"], views, parts)
    if skipped := [path.name for path in parts.files if path.suffix in (".pth", ".pt", ".ckpt")]:
        parts.lines.append(f"skipped, because pickle files can run code: {shorten_list(skipped)}")
    return parts


def _poses(folder: Path, named: Path | None, settings: StageSettings, parts: Parts) -> Views:
    known = layouts.find_known_poses(folder, named)
    if named is not None and (named != layouts.NO_POSES or layouts.has_known_poses(folder)):
        parts.columns["poses"] = named if named == layouts.NO_POSES else named.resolve()
    if known is None:
        parts.lines.append("poses: structure from motion")
        models = {
            path.parent for path in parts.files if path.stem == "cameras" and layouts.model_files(path.parent)
        }
        below = [path for path in parts.files if path.match("transform*.json")]
        _name_unused([*models, *below], "to use these poses, pass --poses", parts)
        unread = [path for pattern in UNREAD_POSES for path in folder.glob(pattern)]
        _name_unused(unread, "for poses, export a COLMAP model or transforms.json", parts)
        photos = list_images(chosen := layouts.photo_folder(folder))
        others = [
            path for path in layouts.largest_copies(layouts.used_images(folder)) if path.parent != chosen
        ]
        if counts := layouts.counted_by_folder(others):
            parts.lines.append(f"  not used: {shorten_list(counts, 5)}; to use them, move them to {chosen}")
        if away := layouts.placeholders(chosen):
            parts.lines.append(f"  left out: {len(away)} photographs that {layouts.NOT_DOWNLOADED}")
        return Views(dict(zip(view_names(photos), photos, strict=True)))
    source, views, max_side_px = read_source(known), Views(), settings.poses.max_side_px
    with_image = {view.image: view for view in source.views if view.image is not None}
    for (image, view), name in zip(with_image.items(), view_names([*with_image]), strict=True):
        try:
            lens, photo, _ = fitted_camera(view, max_side_px)
            if not is_pinhole(lens):
                photo, lens = photo or photo_of(lens), pinhole_of(name, lens, max_side_px)
        except ImageError as error:
            source.drop(view, error)
            continue
        views.held_out |= {name} if view.is_test else set()
        views.photos[name] = image
        K, size_hw = lens.calibration_matrix(), (lens.height, lens.width)
        views.cameras[name] = Camera(name, np.eye(4), K, size_hw, photo)
    source.require_most(settings.poses.min_registered_share, known.files[0], images=True)
    views.posed, parts.posed = source.views, [*views.photos.values()]
    parts.lines.append(f"poses: {', '.join(map(str, known.files))}: {len(views.cameras)} views with an image")
    if missing := source.without_image:
        parts.lines.append(f"  left out: {len(missing)} views without an image: {shorten_list(missing, 5)}")
    if source.left_out:
        reasons = shorten_list([*source.left_out.values()], 5)
        parts.lines.append(f"  left out: {len(source.left_out)} views: {reasons}")
    if source.unposed:
        parts.lines.append(f"  left out: {len(source.unposed)} images without a pose")
    if views.held_out:
        parts.lines.append(f"  {len(views.held_out)} views are held out for tests by the source's own split")
    count = "none; they are triangulated" if source.points is None else f"{len(source.points[0])}"
    source.notes += misfit_notes(source.views, source.points, "points") if source.points is not None else []
    parts.lines += [f"  points: {count}", *(f"  {note}" for note in source.notes)]
    return views


def _gaussians(folder: Path, named: dict[str, Path | None], views: Views, parts: Parts) -> None:
    plys = [named["gaussians"]] if named["gaussians"] is not None else layouts.trained_gaussians(folder)
    if not plys:
        others = [
            path for path in parts.files if path.suffix == ".ply" and b" f_dc_0" in layouts.ply_header(path)
        ]
        _name_unused(others, "to use Gaussians in the coordinates of the poses, pass --gaussians", parts)
        unread = [path for path in parts.files if path.suffix.lower() in layouts.UNREAD_GAUSSIANS]
        _name_unused(unread, "for Gaussians, export an uncompressed 3DGS PLY", parts)
    if not plys or plys[0] == layouts.NO_POSES:
        return
    ply, *others = plys
    if named["gaussians"] is None and not layouts.has_known_poses(folder, named["poses"]):
        parts.lines.append(f"Gaussians: not used, because they need the poses they were made with: {ply}")
        return
    parts.columns["gaussians"] = ply.resolve()
    gaussians, notes = read_gaussians(ply)
    parts.lines += [f"Gaussians: {len(gaussians)} from {ply}", *(f"  {note}" for note in notes)]
    if names := [str(path.relative_to(folder)) for path in others]:
        parts.lines.append(f"  not used: {shorten_list(names, 5)}")
    if layouts.langsplat_level(ply):
        parts.lines.append("  the three levels of LangSplat share their geometry, so one is enough")
    if (dataparser := layouts.dataparser_of(ply, folder)) is not None:
        parts.lines.append(f"  coordinates: nerfstudio's, from {dataparser}")
    elif layouts.is_from_nerfstudio(ply):
        problem = f"unknown, because the {layouts.DATAPARSER} of nerfstudio's run was not found"
        parts.lines.append(f"  coordinates: {problem}; those of the poses are assumed")
    transform, _ = source_from_ply(ply, dataparser, layouts.transforms_of(folder, named["poses"]))
    is_solid = gaussians.opacity_logits > 0
    xyz = gaussians.means[is_solid] @ transform[:3, :3].T + transform[:3, 3]
    points = xyz, to_uint8(base_rgb(gaussians.sh[is_solid]))
    parts.lines += [f"  {note}" for note in misfit_notes(views.posed, points, "Gaussians")]


def _name_unused(paths: list[Path], advice: str, parts: Parts) -> None:
    """Name files and folders that the user may expect to be used."""
    if paths:
        parts.lines.append(f"  not used: {shorten_list([str(path) for path in sorted(paths)], 5)}; {advice}")


def _features(folder: Path, named: Path | None, views: Views, settings: StageSettings, parts: Parts) -> None:
    features = layouts.langsplat_features(folder) if named is None else named
    if features is None or features == layouts.NO_POSES:
        return
    train = [view for view in views.photos if view not in views.held_out]
    maps, lost = read_views(features, {view: views.cameras.get(view) for view in train})
    parts.columns["features"] = features.resolve()
    parts.lines.append(f"features: {features}: masks and vectors of {len(maps)} of {len(train)} views")
    if lost:
        parts.lines.append(f"  left out: {shorten_list(lost, 5)}")
    if not maps:
        return
    view = max(maps, key=lambda view: len(maps[view][0]))
    try:
        model = ClipModel.load(Path(settings.clip.model), settings.clip.variant)
        masks, vectors = read_view(features, view)
        size = masks.size_hw[::-1]  # of LangSplat's copy of the photograph
        image = np.asarray(Image.fromarray(read_image(views.photos[view])).resize(size))
        require_model(model, features, view, image, masks, vectors)
    except HilsplatError as error:
        parts.lines.append(f"  warning: {in_one_line(error)}")


def _labels(folder: Path, named: Path | None, views: Views, parts: Parts) -> None:
    """Choose the label files that can be used."""
    if named == layouts.NO_POSES:
        return
    files = layouts.label_files(folder, named)
    if not files and named is not None:
        expected = "a .json file for each labelled photograph"
        raise SceneError(f"--labels {named} contains no label file", expected=expected)
    if not files:
        return
    lost: list[str] = []
    warnings: list[str] = []
    num_regions = 0
    matched = match_names([path.stem for path in files], views.photos)
    for path in files:
        if (view := matched[path.stem]) is None:
            lost.append(f"{path.name}: no view with an image and a pose has this name")
        elif (copy := f"{Path(view).stem}.json") in parts.labels.values():
            lost.append(f"{path.name}: another file has the labels of {view}")
        else:
            try:
                if regions := annotated_regions(path, warnings):
                    warnings += _shape_notes(views, view, regions[0], path)
                num_regions, parts.labels[path] = num_regions + len(regions), copy
            except HilsplatError as error:
                lost.append(in_one_line(error))
    if len(parts.labels) < len(files) / 2:
        raise SceneError(
            f"only {len(parts.labels)} of {len(files)} label files in {files[0].parent} can be used",
            found=shorten_list(lost, 5),
            fix="export them again, or pass --labels none and import them later with hilsplat annotate",
        )
    count = f"{num_regions} regions in {len(parts.labels)} photographs"
    parts.lines.append(f"labels: {count}, used for evaluation: {files[0].parent}")
    parts.lines += [f"  left out: {shorten_list(lost, 5)}"] if lost else []
    parts.lines += [f"  {shorten_list(warnings, 5)}"] if warnings else []


def _shape_notes(views: Views, view: str, region: LabelledRegion, path: Path) -> list[str]:
    """Return a note on labels that can only fit the undistorted view, whose shape is not yet known.

    Raises:
        HilsplatError: labels don't have the shape of their photograph or undistorted view.
    """
    if (camera := views.cameras.get(view)) is None:
        camera = Camera(view, np.eye(4), np.eye(3), image_size_hw(views.photos[view], upright=True))
    drawn_hw = region.size_hw
    try:
        placement(of_view(camera) if region.on_view else camera, drawn_hw, f"label file {path}")
    except MisalignedArtifactError as error:
        misfit = abs(drawn_hw[0] * camera.size_hw[1] / (drawn_hw[1] * camera.size_hw[0]) - 1)
        if view in views.cameras or misfit > MAX_UNDISTORTION:
            raise
        return [f"{in_one_line(error)}; evaluation refuses it unless the undistorted view has its shape"]
    return []
