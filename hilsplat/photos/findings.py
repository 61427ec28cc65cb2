"""What a scene's folder offers besides photographs: what will be used, what is left out, and why."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from hilsplat.base.errors import SceneError, foreign, in_one_line
from hilsplat.base.files import list_images
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
    read_json_object,
    trained_gaussians,
    vertex_count,
)
from hilsplat.scene.view_names import match_names, view_names
from hilsplat.settings import PosesSettings

MAX_NAMED = 5
"""Maximum number of items of one kind that a line names."""


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


CheckPly = Callable[[Path], list[str]]
"""Function that reads a PLY and returns notes on what cannot be used."""


def find_parts(folder: Path, named: dict[str, Path | None], check_ply: CheckPly | None) -> Parts:
    """Find poses, Gaussians, features and labels: those that the user named, or else those in the folder.

    Without known poses, the coordinates of another program's Gaussians are unknown, so these are ignored.

    Raises:
        SceneError: a path is missing, or most views, labels or Gaussians cannot be used.
    """
    for what, path in named.items():
        if path is not None and path != NO_POSES and not path.exists():
            raise SceneError(f"--{what} {path} is missing", fix="correct the path, or pass `none`")
    parts = Parts()
    views = _poses(folder, named["poses"], parts)
    _gaussians(folder, named, check_ply, parts)
    _features(folder, named["features"], views, parts)
    _labels(folder, named["labels"], views, parts)
    if skipped := [path.name for path in sorted(folder.rglob("*.pth"))[:3]]:
        parts.lines.append(f"skipped, because pickle files can run code: {', '.join(skipped)}")
    return parts


def _poses(folder: Path, named: Path | None, parts: Parts) -> list[str]:
    """Read the poses; return the names of the views to be expected."""
    known = find_known_poses(folder, named)
    if named is not None and (named != NO_POSES or has_known_poses(folder)):
        parts.columns["poses"] = named if named == NO_POSES else named.resolve()
    if known is None:
        parts.lines.append("poses: structure from motion")
        return view_names(list_images(photo_folder(folder)))
    from hilsplat.scene.importers.reading import read_source  # pycolmap is slow to import

    source = read_source(known)
    source.require_most(PosesSettings().min_registered_share, known.files[0])
    files = [view.image for view in source.views if view.image is not None]
    missing = [view.name for view in source.views if view.image is None]
    parts.lines.append(f"poses: {', '.join(map(str, known.files))}: {len(files)} views with an image")
    if missing:
        parts.lines.append(f"  left out: {len(missing)} views without an image: {_listed(missing)}")
    if source.left_out:
        reasons = _listed(list(source.left_out.values()), "; ")
        parts.lines.append(f"  left out: {len(source.left_out)} views: {reasons}")
    if held_out := sum(view.is_test for view in source.views):
        parts.lines.append(f"  {held_out} views are held out for tests by the source's own split")
    count = "none; they are triangulated" if source.points is None else f"{len(source.points[0])}"
    parts.lines += [f"  points: {count}", *(f"  {note}" for note in source.notes)]
    return view_names(files)


def _gaussians(folder: Path, named: dict[str, Path | None], check_ply: CheckPly | None, parts: Parts) -> None:
    plys = [named["gaussians"]] if named["gaussians"] is not None else trained_gaussians(folder)
    if not plys or plys[0] == NO_POSES:
        return
    ply, *others = plys
    if named["gaussians"] is None and not has_known_poses(folder, named["poses"]):
        parts.lines.append(f"Gaussians: not used, because they need the poses they were made with: {ply}")
        return
    parts.columns["gaussians"] = ply.resolve()
    parts.lines.append(f"Gaussians: {vertex_count(ply) or 'unknown number'} from {ply}")
    parts.lines += [f"  {note}" for note in (check_ply(ply) if check_ply else [])]
    if names := [str(path.relative_to(folder)) for path in others]:
        parts.lines.append(f"  not used: {_listed(names)}")
    if langsplat_level(ply):
        parts.lines.append("  the three levels of LangSplat share their geometry, so one is enough")
    if dataparser := dataparser_of(ply, folder):
        parts.lines.append(f"  coordinates: nerfstudio's, from {dataparser}")
    elif is_from_nerfstudio(ply):
        problem = f"unknown, because the {DATAPARSER} of nerfstudio's run was not found"
        parts.lines.append(f"  coordinates: {problem}; those of the poses are assumed")


def _features(folder: Path, named: Path | None, views: list[str], parts: Parts) -> None:
    features = langsplat_features(folder) if named is None else named
    if features is None or features == NO_POSES:
        return
    stems = {path.name.removesuffix("_s.npy") for path in features.glob("*_s.npy")}
    count = sum(view.partition(".")[0] in stems for view in views)
    parts.columns["features"] = features.resolve()
    parts.lines.append(f"features: {features}: masks and vectors of {count} of {len(views)} views")


def _labels(folder: Path, named: Path | None, views: list[str], parts: Parts) -> None:
    """Choose the label files that can be read."""
    if named == NO_POSES:
        return
    files = label_files(folder) if named is None else sorted(named.glob("*.json"))
    if not files and named is not None:
        expected = "a .json file for each labelled photograph"
        raise SceneError(f"--labels {named} contains no label file", expected=expected)
    if not files:
        return
    lost: dict[str, str] = {}
    num_objects = 0
    matched = match_names([path.stem for path in files], views)
    for path in files:
        try:
            with foreign(path, expected="an ISAT file, as in LERF-OVS"):
                num_objects += len(list(read_json_object(path, "export it again")["objects"]))
            parts.labels[path] = f"{Path(matched[path.stem] or path.name).stem}.json"
        except SceneError as error:
            lost[path.name] = in_one_line(error)
    if len(lost) > len(files) / 2:
        raise SceneError(
            f"{len(lost)} of {len(files)} label files in {files[0].parent} cannot be used",
            found=_listed(list(lost.values()), "; "),
            fix="export the labels again, or pass --labels none",
        )
    count = f"{num_objects} in {len(parts.labels)} photographs"
    parts.lines.append(f"labels: {count}, used for evaluation: {files[0].parent}")
    parts.lines += [f"  left out: {reason}" for reason in lost.values()]
    if unposed := [path.name for path in parts.labels if matched[path.stem] is None]:
        parts.lines.append(f"  not scored, because their views have no pose: {_listed(unposed)}")


def _listed(items: list[str], separator: str = ", ") -> str:
    """Return the first items, and the number of the others."""
    more = [f"and {len(items) - MAX_NAMED} more"] if len(items) > MAX_NAMED else []
    return separator.join([*items[:MAX_NAMED], *more])
