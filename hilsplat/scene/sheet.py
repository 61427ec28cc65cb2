"""The scene sheet (config/scenes.tsv), which lists the scenes.

The workflow imports this module at start-up, so it does not import slow modules at the top level.
"""

import difflib
import fnmatch
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from hilsplat.base.errors import SceneError, nearest
from hilsplat.base.files import IMAGE_SUFFIXES, INSTALLED, NAME_RULE, list_images, name_problem, regular
from hilsplat.base.plugins import entry_points
from hilsplat.scene.layouts import NO_POSES, contents, has_known_poses, photo_folder

DEFAULT_SHEET = Path("config/scenes.tsv")  # default scene sheet, relative to the project

COLUMNS = ("dataset", "scene", "group", "source", "unit")
OPTIONAL_COLUMNS = ("gaussians", "features", "poses")
NOTHING = ("", "-")  # values that mark an optional cell as empty
GROUPS = ("benchmark", "development", "dense", "ci", "photos")
"""Groups of the installed sheet, besides those of data sets; a sheet may have more."""

UNITS = ("metre", "arbitrary")
PHOTOS = "photos"  # data set and group of your own photographs
DATA_PREFIX = "data:"  # prefix of a source in the folder of published data sets (`data_root`)
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
    path: Path, checked: Collection[str] | None = None, data_root: str = "", *, text: str | None = None
) -> list[SceneRow]:
    """Read and check the scene sheet: tab-separated, with one header line and `#` for comment lines.

    The columns `gaussians`, `features` and `poses` may be omitted, even at the end of a single row; an empty
    cell or "-" has the same meaning.

    Args:
        checked: scenes, `dataset/scene`, whose source folders must exist and contain images; None for all. A
            run checks only its own scenes, so that the missing folder of another does not stop it.
        data_root: folder of the published data sets, to which `data:` sources are relative (they need not
            exist); empty if not set.
        text: content that will be written to the sheet; None to read the sheet.

    Raises:
        SceneError: the sheet cannot be used; the message gives the line, column and fix.
    """
    lines = content_lines(sheet_text(path) if text is None else text)
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
        row = _row(path, line, dict(zip(header, cells, strict=True)), checked, data_root)
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


def with_installed(rows: Sequence[SceneRow], only: Iterable[str], data_root: str) -> list[SceneRow]:
    """Return the rows, and rows of the installed sheet for names in `only` that match none of them.

    Installed configurations name these scenes; the sheet that `hilsplat new` starts doesn't have them.
    """
    missing = [name for name, matches in matches_of(rows, only).items() if not matches]
    installed = read_sheet(INSTALLED / DEFAULT_SHEET, (), data_root) if missing else []
    more = {row.name: row for matches in matches_of(installed, missing).values() for row in matches}
    return [*rows, *more.values()]


def choose_scenes(
    rows: Sequence[SceneRow], groups: Collection[str], only: Sequence[str]
) -> tuple[SceneRow, ...]:
    """Return the scenes of a run in the order of the sheet: all scenes of the groups, or only named scenes.

    A name (`table-1` or `synthetic/table-1`) or pattern (`synthetic/*`) selects scenes in the groups or, if
    none matches, in any group.
    """
    in_groups = [row for row in rows if row.group in groups]
    if not only:
        return tuple(in_groups)
    chosen: set[str] = set()
    of_groups, of_all = matches_of(in_groups, only), matches_of(rows, only)
    for name in only:
        matches = of_groups[name] or of_all[name]
        if not matches:
            raise SceneError(
                f"setting `only`: no scene is named {name!r}",
                expected=nearest(name, [row.name for row in in_groups or rows]),
                fix="correct the name, or add a row to the scene sheet",
            )
        chosen.update(row.name for row in matches)
    return tuple(row for row in rows if row.name in chosen)


def matches_of(rows: Iterable[SceneRow], names: Iterable[str]) -> dict[str, list[SceneRow]]:
    """Map each name or pattern to the scenes whose name, data set or both it matches (`fnmatch`)."""
    by_name: dict[str, list[SceneRow]] = {}
    for row in rows:
        for name in (row.scene, row.dataset, row.name):
            by_name.setdefault(name, []).append(row)
    matches = {name: fnmatch.filter(by_name, name) if is_pattern(name) else [name] for name in names}
    return {name: [row for match in same for row in by_name.get(match, ())] for name, same in matches.items()}


def is_pattern(name: str) -> bool:
    """Return whether a name has wildcards, which the names of scenes cannot contain."""
    return any(letter in name for letter in "*?[")


def sheet_text(path: Path) -> str:
    try:
        return regular(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise SceneError(f"scene sheet {path} is missing", fix="create it, or correct its path") from error
    except IsADirectoryError as error:
        raise SceneError(f"scene sheet {path} is a folder", fix="pass the path of a file") from error
    except UnicodeDecodeError as error:
        fix = "save it as tab-separated text in UTF-8"
        raise SceneError(f"scene sheet {path} is not UTF-8 text", fix=fix) from error


def content_lines(text: str) -> list[tuple[int, str]]:
    """Return the lines of a sheet with their line numbers, excluding comments and empty lines."""
    return [
        (number, line)
        for number, line in enumerate(text.split("\n"), start=1)
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
    path: Path, line: int, cells: dict[str, str], checked: Collection[str] | None, data_root: str
) -> SceneRow:
    def fault(column: str, problem: str, fix: str, **lines: str) -> SceneError:
        return SceneError(f"{path}, line {line}, column {column}: {problem}", fix=fix, **lines)

    def optional(column: str) -> Path | None:
        cell = cells.get(column, "")
        return None if cell in NOTHING else _resolved(path, cell, data_root)

    for column in ("dataset", "scene", "group"):
        if problem := name_problem(cells[column]):
            fix, name = "choose a different name, such as my-desk_2", cells[column]
            raise fault(column, f"{name!r} is not a valid name", fix, expected=NAME_RULE, found=problem)
    if cells["unit"] not in UNITS:
        problem, expected = f"{cells['unit']!r} is unknown", f"one of {', '.join(UNITS)}"
        raise fault("unit", problem, "correct column unit of that line", expected=expected)
    near = [] if cells["group"] in GROUPS else difflib.get_close_matches(cells["group"], GROUPS, 1, 0.8)
    if near:
        problem, expected = f"{cells['group']!r} is unknown", f"did you mean {near[0]!r}?"
        raise fault("group", problem, "correct the group, or choose another name", expected=expected)
    source = cells["source"]
    if not source:
        raise fault("source", "it is empty", "enter world:<kind>:<seed>, or a folder of images")
    is_generated = source.partition(":")[0] in entry_points("hilsplat.generators")
    if is_generated and generated_of(source) is None:
        expected = "<generator>:<kind>:<seed>, as in world:tabletop:201"
        problem = f"{source!r} does not name a generated scene"
        raise fault("source", problem, "correct the source", expected=expected)
    row = SceneRow(
        **{column: cells[column] for column in COLUMNS},
        folder=None if is_generated else _resolved(path, source, data_root),
        gaussians=optional("gaussians"),
        features=optional("features"),
        poses=NO_POSES if cells.get("poses") == str(NO_POSES) else optional("poses"),
    )
    if checked is None or row.name in checked:
        _check_files(row, cells, fault)
    return row


def _check_files(row: SceneRow, cells: dict[str, str], fault: Callable[..., SceneError]) -> None:
    # The workflow skips and reports scenes missing from a published data set.
    if row.folder is not None and not row.source.startswith(DATA_PREFIX):
        _check_source(row.folder, fault)
    if row.gaussians is not None and (problem := _ply_problem(row.gaussians)):
        fix = 'correct the path, or enter "-" to fit the Gaussians'
        expected = "a 3DGS PLY; relative paths start from the project folder"
        raise fault("gaussians", f"file {row.gaussians} {problem}", fix, expected=expected)
    if row.gaussians is None and row.folder is not None and cells.get("gaussians", "") not in NOTHING:
        problem = f"{cells['gaussians']!r} is relative to data_root, which is not set"
        fix = "set data_root, or enter a path relative to the project folder"
        raise fault("gaussians", problem, fix)
    if row.features is not None and not any(row.features.glob("*_s.npy")):
        fix = 'correct the path, or enter "-" to compute the masks'
        expected = "<image>_s.npy and <image>_f.npy for each image"
        raise fault("features", f"folder {row.features} contains no LangSplat masks", fix, expected=expected)
    if row.poses not in (None, NO_POSES) and not row.poses.exists():
        fix = 'correct the path, or enter "-" to use the poses in the folder'
        expected = f"a COLMAP model, a transforms.json, or {NO_POSES}"
        raise fault("poses", f"{row.poses} is missing", fix, expected=expected)


def _resolved(sheet: Path, cell: str, data_root: str) -> Path | None:
    """Resolve a path against the project root or, for `data:`, the data root (None if that is not set).

    A relative data root starts from the working folder, even if the sheet is the installed one.
    """
    base = project_root(sheet)
    if cell.startswith(DATA_PREFIX):
        if not data_root:
            return None
        base = Path(data_root).expanduser()
    # `Path` would drop the "./" of "./~desk", a folder whose name begins with a tilde.
    return (base / os.path.expanduser(cell.removeprefix(DATA_PREFIX))).resolve()  # noqa: PTH111


def _ply_problem(ply: Path) -> str:
    """Return why a file cannot be a PLY, or an empty string."""
    if not ply.is_file():
        return "is a folder" if ply.is_dir() else "is not a file" if ply.exists() else "is missing"
    with ply.open("rb") as stream:
        head = stream.read(4)
    return "" if head in (b"ply\n", b"ply\r") else f"is not a PLY: it begins with {head!r}"


def _check_source(folder: Path, fault: Callable[..., SceneError]) -> None:
    if not folder.is_dir():
        problem = f"{folder} {'is not a folder' if folder.exists() else 'is missing'}"
        expected = "a folder of images; relative paths start from the project folder"
        raise fault("source", problem, "correct the path, or remove the line", expected=expected)
    if not list_images(photo_folder(folder)) and not has_known_poses(folder):
        raise fault(
            "source",
            f"folder {folder} has no images",
            "correct the path, choose one of several folders, or convert the photographs to JPEG or PNG",
            expected=f"files with suffix {', '.join(sorted(IMAGE_SUFFIXES))} in it, in its images/ or input/ "
            "folder, or in a single folder below",
            found=contents(folder),
        )
