"""Inspection of a folder of photographs, and its addition to the scene sheet."""

import shutil
from collections import Counter, defaultdict
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from hilsplat.base.artifacts import atomic_folder, changing, sha256_of_file, write_text
from hilsplat.base.errors import ImageError, SceneError, first_line
from hilsplat.base.files import NAME_RULE, list_images, name_problem
from hilsplat.base.images import open_image, read_image, require_usable_size, resize_to_fit
from hilsplat.base.progress import track
from hilsplat.base.removal import undone_on_error
from hilsplat.photos.check import CHECK_SIDE_PX, CheckedPhoto, photo_doubts
from hilsplat.photos.intake import prepared_photographs
from hilsplat.scene.features import EXIF_ORIENTATION, exif_focal_px
from hilsplat.scene.layouts import (
    NO_POSES,
    dataparser_of,
    find_known_poses,
    has_known_poses,
    label_files,
    langsplat_features,
    langsplat_level,
    photo_folder,
    trained_gaussians,
)
from hilsplat.scene.sheet import (
    COLUMNS,
    MIN_PHOTOS,
    NOTHING,
    PHOTOS,
    content_lines,
    project_root,
    read_sheet,
)
from hilsplat.scene.view_names import view_names

OTHER_PHOTO_SUFFIXES = frozenset({".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".gif", ".jxl"})
"""Suffixes of unsupported photograph formats. Such files are counted and reported as skipped."""


@dataclass(frozen=True)
class PhotoReport:
    """Report on a folder of photographs.

    Attributes:
        sizes: number of readable photographs per upright size (height, width), px.
        unreadable: (file name, reason) of each image that cannot be read.
        num_rotated: number of photographs that are rotated according to their EXIF orientation.
        duplicates: groups of file names with identical bytes.
        passed_over: number of skipped files in unsupported photograph formats, by suffix.
        doubts: likely problems and what to do about them (`check`).
        notes: how the folder was made (`intake`), and which additional files are used.
    """

    folder: Path
    sizes: dict[tuple[int, int], int]
    unreadable: tuple[tuple[str, str], ...]
    num_rotated: int
    duplicates: tuple[tuple[str, ...], ...]
    passed_over: dict[str, int]
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def num_readable(self) -> int:
        """Number of readable photographs, including identical copies."""
        return sum(self.sizes.values())

    def __str__(self) -> str:
        lines = [*self.notes, f"{self.num_readable} photographs in {self.folder}"]
        for (height, width), count in sorted(self.sizes.items(), key=lambda item: (-item[1], item[0])):
            lines.append(f"  {count:>5}  of {width} x {height} px (width x height)")
        if self.num_rotated:
            lines.append(f"  {self.num_rotated:>5}  rotated upright according to their EXIF orientation")
        for names in self.duplicates:
            lines.append(f"  {len(names):>5}  are identical: {', '.join(names)}")
        for suffix, count in sorted(self.passed_over.items()):
            lines.append(f"  {count:>5}  {suffix} files skipped: convert them to JPEG or PNG to use them")
        if self.unreadable:
            lines.append(f"  {len(self.unreadable):>5}  cannot be read:")
            lines += [f"           {name}: {reason}" for name, reason in self.unreadable]
        lines += [f"  warning: {doubt}" for doubt in self.doubts]
        return "\n".join(lines)


def inspect_photos(folder: Path, poses: Path | None = None) -> PhotoReport:
    """Decode all photographs in a folder (or its `images/`), and report its contents and likely problems.

    If given, `poses` are used instead of those in the folder (`has_known_poses`).

    Raises:
        SceneError: a photograph has an unusable name, or two photographs differ only in their suffix.
    """
    where = photo_folder(folder)
    photos = list_images(where)
    view_names(photos)
    sizes: Counter[tuple[int, int]] = Counter()
    unreadable: list[tuple[str, str]] = []
    by_digest: dict[str, list[str]] = defaultdict(list)
    num_rotated = 0
    checked: list[CheckedPhoto] = []
    for path in track(photos, "photographs checked"):
        if not path.exists() or path.stat().st_size == 0:
            is_link = not path.exists()
            reason = "it is a link to a file that does not exist" if is_link else "the file is empty"
            unreadable.append((path.name, reason))
            continue
        try:
            pixels = read_image(path)
            require_usable_size(path, pixels.shape[:2])
        except ImageError as error:
            reason = first_line(error.__cause__ or error).replace(str(path), path.name)
            unreadable.append((path.name, f"{reason} ({path.stat().st_size} bytes)"))
            continue
        size_hw = (pixels.shape[0], pixels.shape[1])
        sizes[size_hw] += 1
        with open_image(path) as image:
            num_rotated += image.getexif().get(EXIF_ORIENTATION, 1) not in (0, 1)
        grey = cv2.cvtColor(resize_to_fit(pixels, CHECK_SIDE_PX), cv2.COLOR_RGB2GRAY)
        checked.append(CheckedPhoto(path.name, size_hw, exif_focal_px(path, size_hw), grey))
        by_digest[sha256_of_file(path)].append(path.name)
    copies = {name for names in by_digest.values() for name in names[1:]}
    distinct = [photo for photo in checked if photo.name not in copies]
    suffixes = Counter(path.suffix.lower() for path in where.iterdir() if path.is_file())
    return PhotoReport(
        folder=where,
        sizes=dict(sizes),
        unreadable=tuple(unreadable),
        num_rotated=num_rotated,
        duplicates=tuple(tuple(names) for names in by_digest.values() if len(names) > 1),
        passed_over={suffix: count for suffix, count in suffixes.items() if suffix in OTHER_PHOTO_SUFFIXES},
        doubts=tuple(photo_doubts(distinct, have_poses=has_known_poses(folder, poses))),
    )


def add_scene(
    sheet: Path,
    name: str,
    photos: Path,
    frames: int = 60,
    poses: Path | None = None,
    gaussians: Path | None = None,
    features: Path | None = None,
    labels: Path | None = None,
) -> PhotoReport:
    """Append your own photographs to the sheet as scene `photos/<name>`, creating the sheet if it is missing.

    A folder is used in place: the sheet refers to it, with a relative path if it is inside the project.
    Frames of a video and the contents of an archive are written to `photos/<name>/` in the project. For the
    last four arguments, None uses the files found in the folder; `NO_POSES` ("none") ignores them.

    Args:
        photos: folder of photographs or of videos, a video, or a zip archive of photographs.
        frames: maximum number of frames extracted from videos.
        poses: a COLMAP model or transforms file, used instead of structure from motion.
        gaussians: a 3DGS PLY in the coordinates of the poses or in nerfstudio's training coordinates, used
            instead of fitting Gaussians.
        features: folder of LangSplat's masks and CLIP vectors, used instead of SAM and CLIP.
        labels: folder of label files from LERF-OVS or `hilsplat annotate`, used only for evaluation and
            copied to `annotated/photos/<name>/` in the project.

    Raises:
        SceneError: the name is invalid or taken, photographs cannot be read, or there are fewer than three
            distinct photographs and no known poses. The sheet is then left unchanged.
    """
    sheet, photos = Path(sheet), Path(photos).expanduser().resolve()
    if problem := name_problem(name):
        raise SceneError(
            f"{name!r} is not a valid scene name",
            expected=NAME_RULE,
            found=problem,
            fix="choose another name, such as my-desk_2",
        )
    with changing(sheet) as sheet:  # `sheet` may be a link
        _require_new(sheet, name)
        root = project_root(sheet)
        with prepared_photographs(photos, root / PHOTOS / name, frames) as (folder, made):
            extra = _trained(folder, {"poses": poses, "gaussians": gaussians, "features": features})
            notes = [*made, *_notes(folder, extra)]
            annotated = root / "annotated" / PHOTOS / name
            files = [] if annotated.exists() else _labels(folder, labels)
            if files:
                notes.append(f"labels for {len(files)} photographs, used for evaluation: {files[0].parent}")
            report = replace(inspect_photos(folder, poses), notes=tuple(notes))
            _check(report, has_known_poses(folder, poses))
            if files:
                with atomic_folder(annotated) as target:
                    for path in files:
                        shutil.copy2(path, target / path.name)
            with undone_on_error(annotated) if files else nullcontext():
                _append(sheet, name, folder, extra)
        return report


def _require_new(sheet: Path, name: str) -> None:
    rows = read_sheet(sheet, checked_groups=()) if sheet.exists() else []
    taken = {row.name.casefold(): row for row in rows}
    if (row := taken.get(f"{PHOTOS}/{name}".casefold())) is not None:
        raise SceneError(
            f"scene {row.name} is already in {sheet}",
            found=f"source {row.source}",
            fix="choose a different name, or remove the scene's line from the sheet first",
        )


def _trained(folder: Path, named: dict[str, Path | None]) -> dict[str, Path]:
    """Map sheet columns to the user's paths or, by default, to other programs' files in the folder.

    Without known poses, the coordinates of another program's Gaussians are unknown, so these are ignored.
    """
    for what, path in named.items():
        if path is not None and path != NO_POSES and not path.exists():
            raise SceneError(f"--{what} {path} is missing", fix="correct the path, or pass `none`")
    found = {"gaussians": trained_gaussians(folder), "features": langsplat_features(folder)}
    if not has_known_poses(folder, named["poses"]):
        found["gaussians"] = None
    chosen = {what: path or found.get(what) for what, path in named.items()}
    if chosen["poses"] == NO_POSES and not has_known_poses(folder):
        chosen["poses"] = None
    return {
        what: path if path == NO_POSES else path.resolve()
        for what, path in chosen.items()
        if path is not None and (path != NO_POSES or what == "poses")
    }


def _notes(folder: Path, extra: dict[str, Path]) -> list[str]:
    known = find_known_poses(folder, extra.get("poses"))
    notes = [f"poses: {', '.join(map(str, known.files)) if known else 'structure from motion'}"]
    notes += [f"{what}: {path}" for what, path in extra.items() if what != "poses"]
    if (ply := extra.get("gaussians")) and langsplat_level(ply):
        notes.append("the three levels of LangSplat share their geometry, so the Gaussians of one are enough")
    if (ply := extra.get("gaussians")) and (dataparser := dataparser_of(ply, folder)):
        notes.append(f"coordinates of the Gaussians: nerfstudio's, from {dataparser}")
    if skipped := [path.name for path in sorted(folder.rglob("*.pth"))[:3]]:
        notes.append(f"skipped, because pickle files can run code: {', '.join(skipped)}")
    return notes


def _labels(folder: Path, named: Path | None) -> list[Path]:
    """Return the label files given by the user, or else those found in the folder."""
    if named is None or named == NO_POSES:
        return label_files(folder) if named is None else []
    files = sorted(named.glob("*.json"))
    if not files:
        expected = "a .json file for each labelled photograph"
        raise SceneError(f"--labels {named} contains no label file", expected=expected)
    return files


def _check(report: PhotoReport, have_poses: bool) -> None:
    if report.unreadable:
        raise SceneError(
            f"{len(report.unreadable)} photographs in {report.folder} cannot be read",
            found="; ".join(f"{file}: {reason}" for file, reason in report.unreadable),
            fix="remove them from the folder or replace them with intact copies, then try again",
        )
    num_distinct = report.num_readable - sum(len(names) - 1 for names in report.duplicates)
    if num_distinct < MIN_PHOTOS and not have_poses:
        found = [f"{num_distinct} distinct readable photographs"]
        found += [f"{count} {suffix} files skipped" for suffix, count in sorted(report.passed_over.items())]
        raise SceneError(
            f"{report.folder} has too few photographs",
            expected=f"at least {MIN_PHOTOS} (20 or more are better)",
            found="; ".join(found),
            fix="add photographs of the same scene, or record a longer video while walking around it",
        )


def _append(sheet: Path, name: str, photos: Path, extra: dict[str, Path]) -> None:
    root = project_root(sheet)
    places = {
        what: path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
        for what, path in {"source": photos, **extra}.items()
    }
    for place in places.values():
        if not place.isprintable() or place.startswith("world:"):
            problem = f"the path {place!r} cannot be written to the scene sheet"
            raise SceneError(problem, fix="rename the folder")
    values = {"dataset": PHOTOS, "scene": name, "group": PHOTOS, "unit": "arbitrary", **places}
    if sheet.exists():
        text = sheet.read_text(encoding="utf-8-sig")
        first = content_lines(sheet)[0][1]
        header = [cell.strip() for cell in first.split("\t")]
        if new := [column for column in extra if column not in header]:
            header += new  # existing rows may be shorter than the header
            text = text.replace(first, "\t".join(header), 1)
        if not text.endswith("\n"):
            text += "\n"
    else:
        header = [*COLUMNS, *extra]
        text = "\t".join(header) + "\n"
    write_text(sheet, text + "\t".join(values.get(column, NOTHING[1]) for column in header) + "\n")
