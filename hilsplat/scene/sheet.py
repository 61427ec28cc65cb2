"""The scene sheet (config/scenes.tsv), which lists the scenes.

The workflow imports this module at start-up, so it does not import slow modules at the top level.
"""

import difflib
import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hilsplat.base.errors import SceneError
from hilsplat.base.files import IMAGE_SUFFIXES, NAME_RULE, list_images, name_problem, regular
from hilsplat.base.plugins import entry_points
from hilsplat.scene.layouts import NO_POSES, contents, has_known_poses, photo_folder

DEFAULT_SHEET = Path("config/scenes.tsv")
"""Default scene sheet, relative to the project."""

COLUMNS = ("dataset", "scene", "group", "source", "unit")
OPTIONAL_COLUMNS = ("gaussians", "features", "poses")
NOTHING = ("", "-")
"""Values that mark an optional cell as empty."""
GROUPS = ("benchmark", "development", "dense", "ci", "photos")
"""Groups of the installed sheet, besides those of data sets; a sheet may have more."""

UNITS = ("metre", "arbitrary")
PHOTOS = "photos"
"""Data set and group of your own photographs."""

MIN_PHOTOS = 3
"""Minimum number of photographs for structure from motion."""

DATA_PREFIX = "data:"
"""Prefix of a source in the folder of published data sets (`data_root`)."""
GENERATED = re.compile(r"([a-z][a-z0-9_]*):([a-z][a-z0-9_-]*):([0-9]{1,9})")


class Generated(NamedTuple):
    """Parts of the source of a scene that a plugin generates (`datasets.generators`)."""

    generator: str
    kind: str
    seed: int


def generated_of(source: str) -> Generated | None:
    """Return the parts of a generated scene's source; None if it is another source."""
    match = GENERATED.fullmatch(source)
    if match is None or match[1] not in entry_points("hilsplat.generators"):
        return None
    return Generated(match[1], match[2], int(match[3]))


@dataclass(frozen=True)
class SceneRow:
    """One scene in the sheet. Paths are resolved; `data:` paths are None if no data root is set.

    Attributes:
        dataset: first part of the scene's path under `results/`; `scene` is the second.
        group: scenes that are run together; a run names its groups.
        source: `<generator>:<kind>:<seed>`, `data:<folder below data_root>`, or a folder.
        unit: unit of the source's lengths, "metre" or "arbitrary".
        folder: the source folder; None for a generated scene.
        gaussians: 3DGS PLY in the source's coordinates, used instead of a fit; None to fit.
        features: folder of LangSplat's masks and CLIP vectors; None to run SAM and CLIP.
        poses: COLMAP model or transforms file used instead of the poses in the folder; `NO_POSES` to ignore
            the folder's poses; None to use them.
    """

    dataset: str
    scene: str
    group: str
    source: str
    unit: str
    folder: Path | None
    gaussians: Path | None = None
    features: Path | None = None
    poses: Path | None = None

    @property
    def name(self) -> str:
        """`<dataset>/<scene>`."""
        return f"{self.dataset}/{self.scene}"

    @property
    def generated(self) -> Generated | None:
        """Generator, kind and seed of a generated scene; None for other scenes."""
        return generated_of(self.source)


def project_root(sheet: Path) -> Path:
    """Return the base folder of relative sources: the parent of `config/`, or else the sheet's own folder."""
    folder = sheet.resolve().parent
    return folder.parent if folder.name == "config" else folder


def read_sheet(
    path: Path, checked_groups: Collection[str] | None = None, data_root: str = ""
) -> list[SceneRow]:
    """Read and check the scene sheet: tab-separated, with one header line and `#` for comment lines.

    The columns `gaussians`, `features` and `poses` may be omitted, even at the end of a single row; an empty
    cell or "-" has the same meaning.

    Args:
        checked_groups: groups whose source folders must exist and contain images; None for all. A run checks
            only the groups it runs, so that a missing folder in a different group does not stop it.
        data_root: folder of the published data sets, to which `data:` sources are relative (they need not
            exist); empty if not set.

    Raises:
        SceneError: the sheet cannot be used; the message gives the line, column and fix.
    """
    lines = content_lines(path)
    if not lines:
        raise SceneError(f"scene sheet {path} is empty", fix=f"begin it with the line: {' '.join(COLUMNS)}")
    header_line, header_text = lines[0]
    header = [cell.strip() for cell in header_text.split("\t")]
    _check_header(path, header_line, header)
    rows: list[SceneRow] = []
    line_of: dict[str, int] = {}
    for line, text in lines[1:]:
        cells = [cell.strip() for cell in text.split("\t")]
        if len(COLUMNS) <= len(cells) and not set(header[len(cells) :]) - set(OPTIONAL_COLUMNS):
            cells += [NOTHING[1]] * (len(header) - len(cells))
        if len(cells) != len(header):
            raise SceneError(
                f"{path}, line {line}: wrong number of columns",
                expected=f"{len(header)} columns, separated by tabs ({' '.join(header)})",
                found=f"{len(cells)}: {text!r}",
                fix="separate columns with one tab; only optional columns at the end may be missing",
            )
        row = _row(path, line, dict(zip(header, cells, strict=True)), checked_groups, data_root)
        # Names that differ only in case would share a folder on some file systems.
        if (key := row.name.casefold()) in line_of:
            raise SceneError(
                f"{path}, line {line}, column scene: {row.name} is listed twice",
                found=f"also on line {line_of[key]}",
                fix="remove one of the two lines, or rename one of the scenes",
            )
        line_of[key] = line
        rows.append(row)
    return rows


def row_of_data(name: str, data_root: str) -> SceneRow:
    """Return a row, in metres, for a scene that is not listed in a sheet, such as `waymo/<segment>`."""
    dataset, _, scene = name.partition("/")
    folder = Path(data_root).expanduser() / name
    return SceneRow(dataset, scene, dataset, f"{DATA_PREFIX}{name}", "metre", folder)


def choose_scenes(
    rows: Sequence[SceneRow], groups: Collection[str], only: Sequence[str]
) -> tuple[SceneRow, ...]:
    """Return the scenes of a run in the order of the sheet: all scenes of the groups, or only named scenes.

    A name (`table-1` or `synthetic/table-1`) selects scenes in the groups or, if none matches, in any group.
    """
    in_groups = [row for row in rows if row.group in groups]
    if not only:
        return tuple(in_groups)
    chosen: set[str] = set()
    for name in only:
        found = [row.name for row in in_groups if name in (row.scene, row.name)]
        found = found or [row.name for row in rows if name in (row.scene, row.name)]
        if not found:
            raise SceneError(
                f"setting `only`: no scene is named {name!r}",
                expected=", ".join(row.name for row in in_groups or rows),
                fix="correct the name, or add a row to the scene sheet",
            )
        chosen.update(found)
    return tuple(row for row in rows if row.name in chosen)


def content_lines(path: Path) -> list[tuple[int, str]]:
    """Return the sheet's lines with their line numbers, excluding comments and empty lines."""
    try:
        text = regular(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise SceneError(f"scene sheet {path} is missing", fix="create it, or correct its path") from error
    except IsADirectoryError as error:
        raise SceneError(f"scene sheet {path} is a folder", fix="pass the path of a file") from error
    except UnicodeDecodeError as error:
        fix = "save it as tab-separated text in UTF-8"
        raise SceneError(f"scene sheet {path} is not UTF-8 text", fix=fix) from error
    return [
        (number, line)
        for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def _check_header(path: Path, line: int, header: list[str]) -> None:
    missing = [column for column in COLUMNS if column not in header]
    unknown = [column for column in header if column not in (*COLUMNS, *OPTIONAL_COLUMNS)]
    repeated = [column for column, count in Counter(header).items() if count > 1]
    kinds = (("missing", missing), ("unknown", unknown), ("repeated", repeated))
    problems = [f"{what}: {', '.join(map(repr, columns))}" for what, columns in kinds if columns]
    if problems:
        raise SceneError(
            f"{path}, line {line}: the header is not valid",
            expected=f"tab-separated columns {' '.join(COLUMNS)}; optional: {' '.join(OPTIONAL_COLUMNS)}",
            found="; ".join(problems),
            fix="correct the header line, and separate columns with tabs, not spaces or commas",
        )


def _row(
    path: Path, line: int, cells: dict[str, str], checked_groups: Collection[str] | None, data_root: str
) -> SceneRow:
    def fault(column: str, problem: str, **lines: str) -> SceneError:
        return SceneError(f"{path}, line {line}, column {column}: {problem}", **lines)

    def optional(column: str) -> Path | None:
        cell = cells.get(column, "")
        return None if cell in NOTHING else _resolved(path, cell, data_root)

    for column in ("dataset", "scene", "group"):
        if problem := name_problem(cells[column]):
            fix = "choose a different name, such as my-desk_2"
            bad = f"{cells[column]!r} is not a valid name"
            raise fault(column, bad, expected=NAME_RULE, found=problem, fix=fix)
    if cells["unit"] not in UNITS:
        expected, fix = f"one of {', '.join(UNITS)}", "correct column unit of that line"
        raise fault("unit", f"{cells['unit']!r} is unknown", expected=expected, fix=fix)
    near = difflib.get_close_matches(cells["group"], GROUPS, n=1, cutoff=0.8)
    if near and cells["group"] not in GROUPS:
        expected, fix = f"did you mean {near[0]!r}?", "correct the group, or choose a more different name"
        raise fault("group", f"{cells['group']!r} is unknown", expected=expected, fix=fix)
    source, folder = cells["source"], None
    is_checked = checked_groups is None or cells["group"] in checked_groups
    if not source:
        raise fault("source", "it is empty", fix="enter world:<kind>:<seed>, or a folder of images")
    if source.partition(":")[0] in entry_points("hilsplat.generators"):
        if generated_of(source) is None:
            raise fault(
                "source",
                f"{source!r} does not name a generated scene",
                expected="<generator>:<kind>:<seed>, as in world:tabletop:201",
                fix="correct the source",
            )
    else:
        folder = _resolved(path, source, data_root)
        # The workflow skips and reports scenes missing from a published data set.
        if folder is not None and is_checked and not source.startswith(DATA_PREFIX):
            _check_source(f"{path}, line {line}, column source", folder)
    gaussians, features = optional("gaussians"), optional("features")
    poses = NO_POSES if cells.get("poses") == str(NO_POSES) else optional("poses")
    fixed = {column: cells[column] for column in COLUMNS}
    row = SceneRow(**fixed, folder=folder, gaussians=gaussians, features=features, poses=poses)
    if not is_checked:
        return row
    if gaussians is not None and (problem := _ply_problem(gaussians)):
        raise fault(
            "gaussians",
            f"file {gaussians} {problem}",
            expected="a 3DGS PLY; relative paths start from the project folder",
            fix='correct the path, or enter "-" to fit the Gaussians',
        )
    if gaussians is None and folder is not None and cells.get("gaussians", "") not in NOTHING:
        raise fault(
            "gaussians",
            f"{cells['gaussians']!r} is relative to data_root, which is not set",
            fix="set data_root, or enter a path relative to the project folder",
        )
    if features is not None and not any(features.glob("*_s.npy")):
        raise fault(
            "features",
            f"folder {features} contains no LangSplat masks",
            expected="<image>_s.npy and <image>_f.npy for each image",
            fix='correct the path, or enter "-" to compute the masks',
        )
    if poses not in (None, NO_POSES) and not poses.exists():
        raise fault(
            "poses",
            f"{poses} is missing",
            expected=f"a COLMAP model, a transforms.json, or {NO_POSES}",
            fix='correct the path, or enter "-" to use the poses in the folder',
        )
    return row


def _resolved(sheet: Path, place: str, data_root: str) -> Path | None:
    """Resolve a path against the project root or, for `data:`, the data root (None if that is not set)."""
    start = project_root(sheet)
    if place.startswith(DATA_PREFIX):
        if not data_root:
            return None
        start = start / Path(data_root).expanduser()
    return (start / Path(place.removeprefix(DATA_PREFIX)).expanduser()).resolve()


def _ply_problem(ply: Path) -> str:
    """Return why a file cannot be a PLY, or an empty string."""
    if not ply.is_file():
        return "is a folder" if ply.is_dir() else "is not a file" if ply.exists() else "is missing"
    with ply.open("rb") as stream:
        head = stream.read(4)
    return "" if head in (b"ply\n", b"ply\r") else f"is not a PLY: it begins with {head!r}"


def _check_source(where: str, folder: Path) -> None:
    if not folder.is_dir():
        raise SceneError(
            f"{where}: {folder} {'is not a folder' if folder.exists() else 'is missing'}",
            expected="a folder of images; relative paths start from the project folder",
            fix="correct the path, or remove the line",
        )
    if not list_images(photo_folder(folder)) and not has_known_poses(folder):
        raise SceneError(
            f"{where}: folder {folder} has no images",
            expected=f"files with suffix {', '.join(sorted(IMAGE_SUFFIXES))} in it, in its images/ or input/ "
            "folder, or in a single folder below",
            found=contents(folder),
            fix="correct the path, choose one of several folders, or convert the photographs to JPEG or PNG",
        )
