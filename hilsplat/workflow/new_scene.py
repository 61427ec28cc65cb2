"""Addition of a folder of photographs to the scene sheet."""

import os
import shutil
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from hilsplat.base.artifacts import write_text
from hilsplat.base.atomic import atomic_folder, changing
from hilsplat.base.errors import SceneError
from hilsplat.base.files import NAME_RULE, name_problem
from hilsplat.base.removal import undone_on_error
from hilsplat.configuration import StageSettings
from hilsplat.photos.check import PhotoReport, inspect_photos
from hilsplat.photos.intake import prepared_photographs
from hilsplat.scene.layouts import MIN_PHOTOS, contents
from hilsplat.scene.sheet import (
    COLUMNS,
    NOTHING,
    PHOTOS,
    content_lines,
    project_root,
    read_sheet,
    sheet_text,
)
from hilsplat.workflow.findings import Parts, find_parts
from hilsplat.workflow.scene_data import SceneData


def add_scene(
    sheet: Path,
    name: str,
    photos: Path,
    frames: int = 60,
    poses: Path | None = None,
    gaussians: Path | None = None,
    features: Path | None = None,
    labels: Path | None = None,
    *,
    settings: StageSettings | None = None,
    dry_run: bool = False,
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
        settings: those of the run, for poses and CLIP; None: the defaults.
        dry_run: only report; videos and archives are converted in a temporary folder.

    Raises:
        SceneError: the name is invalid or taken, a path cannot be written to the sheet, the labels differ
            from those of an earlier scene of that name, photographs cannot be read, or there are fewer than
            three distinct photographs and no known poses. The sheet is then left unchanged.
        SettingsError, ArtifactError: a run would refuse a file for its name, or for its time in the future.
    """
    sheet, photos = Path(sheet), Path(photos)
    photos = (photos if photos.exists() else Path(os.path.expanduser(photos))).resolve()  # noqa: PTH111
    if problem := name_problem(name):
        raise SceneError(
            f"{name!r} is not a valid scene name",
            expected=NAME_RULE,
            found=problem,
            fix="choose another name, such as my-desk_2",
        )
    settings = settings or StageSettings()
    named = {"poses": poses, "gaussians": gaussians, "features": features, "labels": labels}
    with nullcontext(sheet) if dry_run else changing(sheet) as sheet:  # `sheet` may be a link
        _require_new(sheet, name)
        root = project_root(sheet)
        with TemporaryDirectory() if dry_run else nullcontext(root) as base:
            target = Path(base) / PHOTOS / name
            with prepared_photographs(photos, target, frames) as (folder, notes):
                parts = find_parts(folder, named, settings)
                annotated = root / "annotated" / PHOTOS / name
                copied_labels = _labels_to_copy(annotated, parts)
                report = inspect_photos(folder, parts.posed)
                report = replace(report, notes=(*notes, *parts.lines), columns=parts.columns)
                _check(report, bool(parts.posed), settings.poses.min_registered_share)
                text = _with_row(sheet, name, folder, parts.columns)
                if dry_run:
                    return report
                if copied_labels:
                    with atomic_folder(annotated) as copies:
                        for path, copy in copied_labels.items():
                            shutil.copyfile(path, copies / copy)
                with undone_on_error(annotated) if copied_labels else nullcontext():
                    write_text(sheet, text)
        return report


def _labels_to_copy(annotated: Path, parts: Parts) -> dict[Path, str]:
    """Return the labels to copy to the scene's annotations; raise SceneError if others are there."""
    present = [] if not annotated.exists() else sorted(annotated.iterdir())
    files = {path.name: path.read_bytes() for path in present if path.suffix == ".json"}
    if not parts.labels and files:
        parts.lines.append(
            f"labels: {len(files)} files of an earlier scene, used for evaluation: {annotated}\n"
            "  move them if they are not of these photographs"
        )
    elif present and files != {copy: path.read_bytes() for path, copy in parts.labels.items()}:
        raise SceneError(
            f"{annotated} has files of an earlier scene, which differ from the labels to be used",
            found=", ".join(path.name for path in present[:3]),
            fix="move them, choose another name, or pass --labels none to keep them",
        )
    return {} if present else parts.labels


def _require_new(sheet: Path, name: str) -> None:
    for row in read_sheet(sheet, ()) if sheet.exists() else []:
        if row.name.casefold() == f"{PHOTOS}/{name}".casefold():
            raise SceneError(
                f"scene {row.name} is already in {sheet}",
                found=f"source {row.source}",
                fix="choose a different name, or remove the scene's line from the sheet first",
            )


def _check(report: PhotoReport, have_poses: bool, min_share: float) -> None:
    total = report.num_readable + len(report.unreadable)
    unreadable = [f"{file}: {reason}" for file, reason in report.unreadable]
    if report.num_readable < min_share * total:
        raise SceneError(
            f"{len(report.unreadable)} of {total} photographs in {report.folder} cannot be read",
            found="; ".join(unreadable),
            fix="remove them from the folder or replace them with intact copies, then try again",
        )
    num_distinct = report.num_readable - sum(len(names) - 1 for names in report.duplicates)
    if num_distinct < MIN_PHOTOS and not have_poses:
        distinct = f"{num_distinct} distinct readable photographs"
        raise SceneError(
            f"{report.folder} has too few photographs",
            expected=f"at least {MIN_PHOTOS} (20 or more are better)",
            found="; ".join([distinct, contents(report.folder), *unreadable]),
            fix="pass the folder of the photographs, add others of the scene, or record a longer video",
        )


def _with_row(sheet: Path, name: str, photos: Path, columns: dict[str, Path]) -> str:
    """Return the sheet's text with a row whose paths the reader of the sheet resolves to the given ones.

    The reader strips cells and expands "~", `data:` and generators, unless a path begins with "./".

    Raises:
        HilsplatError: the sheet cannot hold a path, or a run would refuse a file for its name or time.
    """
    root = project_root(sheet)
    meant = {"folder": photos, **columns}
    text = sheet_text(sheet) if sheet.exists() else "\t".join(COLUMNS) + "\n"
    number, first = content_lines(text)[0]
    header = [cell.strip() for cell in first.split("\t")]
    lines = text.removesuffix("\n").split("\n")
    if new := [column for column in columns if column not in header]:
        header += new  # existing rows may be shorter than the header
        lines[number - 1] = "\t".join(header)
    for start in ("", "./"):
        cells = {
            column: start + path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
            for column, path in meant.items()
        }
        values = {"dataset": PHOTOS, "scene": name, "group": PHOTOS, "unit": "arbitrary", **cells}
        values["source"] = cells["folder"]
        row = "\t".join(values.get(column, NOTHING[1]) for column in header)
        text = "\n".join([*lines, row]) + "\n"
        with suppress(SceneError):
            read = read_sheet(sheet, (), text=text)[-1]
            if "".join(cells.values()).isprintable() and all(
                getattr(read, column) in (path, path.resolve()) for column, path in meant.items()
            ):
                break
    else:
        raise SceneError(
            f"a path of {name} cannot be written to the scene sheet",
            found=", ".join(map(repr, cells.values())),
            fix="rename the folder or file",
        )
    SceneData([read], "", str).require_usable_files(read)
    return text
