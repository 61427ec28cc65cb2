"""What a scene's folder offers besides photographs: what will be used, what is left out, and why."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilsplat.base.errors import HilsplatError, ImageError, SceneError, in_one_line, shorten_list
from hilsplat.base.files import list_images
from hilsplat.datasets.images.hi import annotated_regions
from hilsplat.embed.langsplat_files import read_views
from hilsplat.scene.cameras import Camera
from hilsplat.scene.colmap import is_pinhole
from hilsplat.scene.importers.importing import fitted_camera
from hilsplat.scene.importers.reading import read_source
from hilsplat.scene.layouts import (
    DATAPARSER,
    NO_POSES,
    dataparser_of,
    find_known_poses,
    has_known_poses,
    is_from_nerfstudio,
    label_files,
    langsplat_features,
    langsplat_level,
    photo_folder,
    trained_gaussians,
)
from hilsplat.scene.placement import placement
from hilsplat.scene.view_names import match_names, view_names
from hilsplat.settings import PosesSettings
from hilsplat.splat.coordinates import read_gaussians


@dataclass
class Parts:
    """What is used with a folder of photographs.

    Attributes:
        columns: paths for the scene sheet, by column.
        labels: label files to copy, and the names of the copies, which are those of the views.
        lines: what was found, used and left out, for the user.
    """

    columns: dict[str, Path] = field(default_factory=dict)
    labels: dict[Path, str] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


Views = Mapping[str, Camera | None]
"""The views to be expected, and their cameras if these are known and have no distortion."""


def find_parts(folder: Path, named: dict[str, Path | None], settings: PosesSettings) -> Parts:
    """Find poses, Gaussians, features and labels: those that the user named, or else those in the folder.

    Without known poses, the coordinates of another program's Gaussians are unknown, so these are ignored.

    Raises:
        SceneError: a path is missing, or most views, labels or Gaussians cannot be used.
    """
    for what, path in named.items():
        if path is not None and path != NO_POSES and not path.exists():
            raise SceneError(f"--{what} {path} is missing", fix="correct the path, or pass `none`")
    parts = Parts()
    views, held_out = _poses(folder, named["poses"], settings, parts)
    _gaussians(folder, named, parts)
    _features(folder, named["features"], {view: views[view] for view in views if view not in held_out}, parts)
    _labels(folder, named["labels"], views, parts)
    if skipped := [path.name for path in sorted(folder.rglob("*.pth"))[:3]]:
        parts.lines.append(f"skipped, because pickle files can run code: {', '.join(skipped)}")
    return parts


def _poses(folder: Path, named: Path | None, settings: PosesSettings, parts: Parts) -> tuple[Views, set[str]]:
    """Read the poses; return the views to be expected, and which of them the source holds out."""
    known = find_known_poses(folder, named)
    if named is not None and (named != NO_POSES or has_known_poses(folder)):
        parts.columns["poses"] = named if named == NO_POSES else named.resolve()
    if known is None:
        parts.lines.append("poses: structure from motion")
        return dict.fromkeys(view_names(list_images(photo_folder(folder)))), set()
    source = read_source(known)
    with_image = [view for view in source.views if view.image is not None]
    names = view_names([view.image for view in with_image if view.image is not None])
    cameras: dict[str, Camera | None] = {}
    held_out: set[str] = set()
    for view, name in zip(with_image, names, strict=True):
        try:
            lens, *_ = fitted_camera(view, settings.max_side_px)
        except ImageError as error:
            source.drop(view, error)
            continue
        held_out |= {name} if view.is_test else set()
        K, size_hw = lens.calibration_matrix(), (lens.height, lens.width)
        cameras[name] = Camera(name, np.eye(4), K, size_hw) if is_pinhole(lens) else None
    source.require_most(settings.min_registered_share, known.files[0], images=True)
    parts.lines.append(f"poses: {', '.join(map(str, known.files))}: {len(cameras)} views with an image")
    if missing := source.without_image:
        parts.lines.append(f"  left out: {len(missing)} views without an image: {shorten_list(missing, 5)}")
    if source.left_out:
        reasons = shorten_list([*source.left_out.values()], 5)
        parts.lines.append(f"  left out: {len(source.left_out)} views: {reasons}")
    if held_out:
        parts.lines.append(f"  {len(held_out)} views are held out for tests by the source's own split")
    count = "none; they are triangulated" if source.points is None else f"{len(source.points[0])}"
    parts.lines += [f"  points: {count}", *(f"  {note}" for note in source.notes)]
    return cameras, held_out


def _gaussians(folder: Path, named: dict[str, Path | None], parts: Parts) -> None:
    plys = [named["gaussians"]] if named["gaussians"] is not None else trained_gaussians(folder)
    if not plys or plys[0] == NO_POSES:
        return
    ply, *others = plys
    if named["gaussians"] is None and not has_known_poses(folder, named["poses"]):
        parts.lines.append(f"Gaussians: not used, because they need the poses they were made with: {ply}")
        return
    parts.columns["gaussians"] = ply.resolve()
    gaussians, notes = read_gaussians(ply)
    parts.lines += [f"Gaussians: {len(gaussians)} from {ply}", *(f"  {note}" for note in notes)]
    if names := [str(path.relative_to(folder)) for path in others]:
        parts.lines.append(f"  not used: {shorten_list(names, 5)}")
    if langsplat_level(ply):
        parts.lines.append("  the three levels of LangSplat share their geometry, so one is enough")
    if dataparser := dataparser_of(ply, folder):
        parts.lines.append(f"  coordinates: nerfstudio's, from {dataparser}")
    elif is_from_nerfstudio(ply):
        problem = f"unknown, because the {DATAPARSER} of nerfstudio's run was not found"
        parts.lines.append(f"  coordinates: {problem}; those of the poses are assumed")


def _features(folder: Path, named: Path | None, views: Views, parts: Parts) -> None:
    features = langsplat_features(folder) if named is None else named
    if features is None or features == NO_POSES:
        return
    _, lost = read_views(features, views)
    parts.columns["features"] = features.resolve()
    count = f"{len(views) - len(lost)} of {len(views)} views"
    parts.lines.append(f"features: {features}: masks and vectors of {count}")
    if lost:
        parts.lines.append(f"  left out: {shorten_list(lost, 5)}")


def _labels(folder: Path, named: Path | None, views: Views, parts: Parts) -> None:
    """Choose the label files that can be used."""
    if named == NO_POSES:
        return
    files = label_files(folder, named)
    if not files and named is not None:
        expected = "a .json file for each labelled photograph"
        raise SceneError(f"--labels {named} contains no label file", expected=expected)
    if not files:
        return
    lost: list[str] = []
    warnings: list[str] = []
    num_regions = 0
    matched = match_names([path.stem for path in files], views)
    for path in files:
        if (view := matched[path.stem]) is None:
            lost.append(f"{path.name}: no view with an image and a pose has this name")
        elif (copy := f"{Path(view).stem}.json") in parts.labels.values():
            lost.append(f"{path.name}: another file has the labels of {view}")
        else:
            try:
                regions, camera = annotated_regions(path, warnings), views[view]
                if camera is not None and regions:
                    placement(camera, regions[0].size_hw, f"label file {path}")
                num_regions, parts.labels[path] = num_regions + len(regions), copy
            except HilsplatError as error:
                lost.append(in_one_line(error))
    if len(parts.labels) < len(files) / 2:
        raise SceneError(
            f"only {len(parts.labels)} of {len(files)} label files in {files[0].parent} can be used",
            found=shorten_list(lost, 5),
            fix="export the labels again, or pass --labels none",
        )
    count = f"{num_regions} regions in {len(parts.labels)} photographs"
    parts.lines.append(f"labels: {count}, used for evaluation: {files[0].parent}")
    parts.lines += [f"  left out: {shorten_list(lost, 5)}"] if lost else []
    parts.lines += [f"  {shorten_list(warnings, 5)}"] if warnings else []
