"""What a scene's folder offers besides photographs: what will be used, what is left out, and why."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from hilsplat.base.errors import SceneError, foreign, in_one_line
from hilsplat.base.files import list_images
from hilsplat.scene.layouts import (
    NO_POSES,
    dataparser_of,
    find_known_poses,
    has_known_poses,
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

NAMED = 5
"""Maximum number of items of one kind that a line names."""


@dataclass
class Findings:
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


def find_parts(folder: Path, named: dict[str, Path | None], check_ply: CheckPly | None) -> Findings:
    """Find poses, Gaussians, features and labels: those that the user named, or else those in the folder.

    `check_ply` reads a PLY and returns notes on what cannot be used.

    Without known poses, the coordinates of another program's Gaussians are unknown, so these are ignored.

    Raises:
        SceneError: a path is missing, or most views, labels or Gaussians cannot be used.
    """
    for what, path in named.items():
        if path is not None and path != NO_POSES and not path.exists():
            raise SceneError(f"--{what} {path} is missing", fix="correct the path, or pass `none`")
    found = Findings()
    views = _poses(folder, named["poses"], found)
    _gaussians(folder, named, check_ply, found)
    _features(folder, named["features"], views, found)
    _labels(folder, named["labels"], views, found)
    if skipped := [path.name for path in sorted(folder.rglob("*.pth"))[:3]]:
        found.lines.append(f"skipped, because pickle files can run code: {', '.join(skipped)}")
    return found


def _poses(folder: Path, named: Path | None, found: Findings) -> list[str]:
    """Read the poses; return the names of the views to be expected."""
    known = find_known_poses(folder, named)
    if named is not None and (named != NO_POSES or has_known_poses(folder)):
        found.columns["poses"] = named if named == NO_POSES else named.resolve()
    if known is None:
        found.lines.append("poses: structure from motion")
        return view_names(list_images(photo_folder(folder)))
    from hilsplat.scene.importers.known_views import read_source  # pycolmap is slow to import

    source = read_source(known)
    source.require_most(PosesSettings().min_registered_share, known.files[0])
    files = [view.image for view in source.views if view.image is not None]
    missing = [view.name for view in source.views if view.image is None]
    described = ", ".join(map(str, known.files))
    found.lines.append(f"poses: {described}: {len(files)} views with an image")
    if missing:
        found.lines.append(f"  left out: {len(missing)} views without an image: {_listed(missing)}")
    if source.left_out:
        reasons = _listed(list(source.left_out.values()), "; ")
        found.lines.append(f"  left out: {len(source.left_out)} views: {reasons}")
    if held_out := sum(view.is_test for view in source.views):
        found.lines.append(f"  {held_out} views are held out for tests by the source's own split")
    count = "none; they are triangulated" if source.points is None else f"{len(source.points[0])}"
    found.lines += [f"  points: {count}", *(f"  {note}" for note in source.notes)]
    return view_names(files)


def _gaussians(
    folder: Path, named: dict[str, Path | None], check_ply: CheckPly | None, found: Findings
) -> None:
    every = [named["gaussians"]] if named["gaussians"] is not None else trained_gaussians(folder)
    if not every or every[0] == NO_POSES:
        return
    ply, *others = every
    if named["gaussians"] is None and not has_known_poses(folder, named["poses"]):
        found.lines.append(f"Gaussians: not used, because they need the poses they were made with: {ply}")
        return
    found.columns["gaussians"] = ply.resolve()
    found.lines.append(f"Gaussians: {vertex_count(ply) or 'unknown number'} from {ply}")
    found.lines += [f"  {note}" for note in (check_ply(ply) if check_ply else [])]
    if others:
        names = [str(path.relative_to(folder)) for path in others]
        found.lines.append(f"  not used: {_listed(names)}")
    if langsplat_level(ply):
        found.lines.append("  the three levels of LangSplat share their geometry, so one is enough")
    if dataparser := dataparser_of(ply, folder):
        found.lines.append(f"  coordinates: nerfstudio's, from {dataparser}")


def _features(folder: Path, named: Path | None, views: list[str], found: Findings) -> None:
    features = langsplat_features(folder) if named is None else named
    if features is None or features == NO_POSES:
        return
    stems = {path.name.removesuffix("_s.npy") for path in features.glob("*_s.npy")}
    count = sum(view.partition(".")[0] in stems for view in views)
    found.columns["features"] = features.resolve()
    found.lines.append(f"features: {features}: masks and vectors of {count} of {len(views)} views")


def _labels(folder: Path, named: Path | None, views: list[str], found: Findings) -> None:
    """Choose the label files that can be read."""
    if named is None:
        files = label_files(folder)
    else:
        files = [] if named == NO_POSES else sorted(named.glob("*.json"))
        if not files and named != NO_POSES:
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
            found.labels[path] = f"{Path(matched[path.stem] or path.name).stem}.json"
        except SceneError as error:
            lost[path.name] = in_one_line(error)
    if len(lost) > len(files) / 2:
        raise SceneError(
            f"{len(lost)} of {len(files)} label files in {files[0].parent} cannot be used",
            found=_listed(list(lost.values()), "; "),
            fix="export the labels again, or pass --labels none",
        )
    count = f"{num_objects} in {len(found.labels)} photographs"
    found.lines.append(f"labels: {count}, used for evaluation: {files[0].parent}")
    found.lines += [f"  left out: {reason}" for reason in lost.values()]
    if unposed := [path.name for path in found.labels if matched[path.stem] is None]:
        found.lines.append(f"  not scored, because their views have no pose: {_listed(unposed)}")


def _listed(items: list[str], separator: str = ", ") -> str:
    """Return the first items, and the number of the others."""
    more = [f"and {len(items) - NAMED} more"] if len(items) > NAMED else []
    return separator.join([*items[:NAMED], *more])
