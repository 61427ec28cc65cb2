"""The scene sheet (config/scenes.tsv): which scenes there are, and adding one's own photographs.

The workflow imports this module at start-up, so nothing heavy is imported at its top.
"""

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from hilsplat.base.errors import SceneError
from hilsplat.base.files import IMAGE_SUFFIXES, list_images

COLUMNS = ("dataset", "scene", "group", "source", "unit")
GROUPS = ("benchmark", "development", "ci", "photos", "lerf")
UNITS = ("metre", "arbitrary")
PHOTOS = "photos"
"""Data set and group of one's own photographs."""

MIN_PHOTOS = 3
"""Structure from motion needs at least this many."""

MAX_NAME = 100
"""Longest name of a data set or scene; folders and files are named after it."""

NAME_RULE = "letters a-z A-Z, digits, dot, dash and underscore, beginning with a letter or digit"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
DATA_PREFIX = "data:"
"""Begins a source that lies below the folder of real data sets (`data_root`)."""
WORLD_SOURCE = re.compile(r"world:([a-z][a-z0-9_-]*):([0-9]{1,9})")
OTHER_PHOTO_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".gif"}
)
"""Photographs that we do not read; a folder of them deserves a better answer than "no images"."""


@dataclass(frozen=True)
class SceneRow:
    """One scene of the sheet.

    Attributes:
        dataset: data set, first part of its place under `results/`.
        scene: scene name, second part.
        group: "benchmark", "development", "ci", "photos" or a real data set such as "lerf".
        source: `world:<kind>:<seed>`, `data:<folder below data_root>`, or a folder.
        unit: unit of the source's lengths, "metre" or "arbitrary".
        folder: the source folder, resolved; None for a world, and for `data:` without a data root.
    """

    dataset: str
    scene: str
    group: str
    source: str
    unit: str
    folder: Path | None

    @property
    def name(self) -> str:
        """`<dataset>/<scene>`."""
        return f"{self.dataset}/{self.scene}"

    @property
    def world(self) -> tuple[str, int] | None:
        """Kind and seed of a synthetic world, else None."""
        match = WORLD_SOURCE.fullmatch(self.source)
        return (match[1], int(match[2])) if match else None


def name_problem(name: str) -> str | None:
    """What is wrong with the name of a data set or scene, or None."""
    if not name:
        return "it is empty"
    if len(name) > MAX_NAME:
        return f"it is longer than {MAX_NAME} characters"
    if ".." in name:
        return 'it contains ".."'
    if NAME.fullmatch(name):
        return None
    if not re.fullmatch("[A-Za-z0-9]", name[0]):
        return f"it begins with {name[0]!r}"
    bad = sorted({letter for letter in name if not re.fullmatch("[A-Za-z0-9._-]", letter)})
    return f"it contains {', '.join(repr(letter) for letter in bad)}"


def project_root(sheet: Path) -> Path:
    """Folder that relative sources start from: above `config/`, or else the sheet's own folder."""
    folder = Path(sheet).resolve().parent
    return folder.parent if folder.name == "config" else folder


def photo_folder(folder: Path) -> Path:
    """Where the photographs of a source are: the folder itself, or its `images/` where it has none."""
    folder = Path(folder)
    if not list_images(folder) and (folder / "images").is_dir():
        return folder / "images"
    return folder


def has_known_poses(folder: Path) -> bool:
    """Whether a folder brings its own poses (COLMAP model or transforms*.json)."""
    return (folder / "sparse").is_dir() or any(folder.glob("transforms*.json"))


def read_sheet(
    path: Path, checked_groups: Collection[str] | None = None, data_root: str = ""
) -> list[SceneRow]:
    """Read and check the scene sheet: tab-separated, one header line, `#` begins a comment line.

    Args:
        path: the sheet; relative sources start from its project root.
        checked_groups: groups whose source folders must exist and hold images; None for all. A
            run checks the groups it runs, so that a lost folder of another group does not stop it.
        data_root: folder of the real data sets, which `data:` sources start from; where it is
            empty such rows have no folder.

    Raises:
        SceneError: naming sheet, line, column and the way out.
    """
    path = Path(path)
    lines = _content_lines(path)
    if not lines:
        raise SceneError(f"scene sheet {path} is empty", fix=f"begin it with the line: {_joined(COLUMNS)}")
    header_line, header_text = lines[0]
    header = [cell.strip() for cell in header_text.split("\t")]
    _check_header(path, header_line, header)
    rows: list[SceneRow] = []
    line_of: dict[str, int] = {}
    for line, text in lines[1:]:
        cells = [cell.strip() for cell in text.split("\t")]
        if len(cells) != len(header):
            raise SceneError(
                f"{path}, line {line}: wrong number of columns",
                expected=f"{len(header)} columns, separated by tabs ({_joined(header)})",
                found=f"{len(cells)}: {text!r}",
                fix="separate the columns by one tab each, and leave none out",
            )
        row = _row(path, line, dict(zip(header, cells, strict=True)), checked_groups, data_root)
        # Names that differ in case only would share a folder on some file systems.
        if (key := row.name.casefold()) in line_of:
            raise SceneError(
                f"{path}, line {line}, column scene: {row.name} is listed twice",
                found=f"also on line {line_of[key]}",
                fix="remove one of the two lines, or rename its scene",
            )
        line_of[key] = line
        rows.append(row)
    return rows


def _content_lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines of the sheet without comments and empty ones."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise SceneError(f"scene sheet {path} is missing", fix="write one, or correct its path") from error
    except IsADirectoryError as error:
        raise SceneError(f"scene sheet {path} is a folder", fix="give the path of a file") from error
    except UnicodeDecodeError as error:
        raise SceneError(
            f"scene sheet {path} is no UTF-8 text", fix="save it as tab-separated text in UTF-8"
        ) from error
    return [
        (number, line)
        for number, line in enumerate(text.replace("\r\n", "\n").split("\n"), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]


def _joined(columns: tuple[str, ...] | list[str]) -> str:
    return " ".join(columns)


def _check_header(path: Path, line: int, header: list[str]) -> None:
    """Refuse missing, unknown or repeated columns."""
    missing = [column for column in COLUMNS if column not in header]
    unknown = [column for column in header if column not in COLUMNS]
    repeated = [column for column, count in Counter(header).items() if count > 1]
    if missing or unknown or repeated:
        problems = [
            f"{what}: {', '.join(repr(column) for column in columns)}"
            for what, columns in (("missing", missing), ("unknown", unknown), ("repeated", repeated))
            if columns
        ]
        raise SceneError(
            f"{path}, line {line}: the header cannot be used",
            expected=f"the columns {_joined(COLUMNS)}, separated by tabs",
            found="; ".join(problems),
            fix="correct the header line; blanks or commas do not separate columns",
        )


def _row(
    path: Path, line: int, cells: dict[str, str], checked_groups: Collection[str] | None, data_root: str
) -> SceneRow:
    """Check one line of the sheet and make its row."""
    for column in ("dataset", "scene"):
        if problem := name_problem(cells[column]):
            raise SceneError(
                f"{path}, line {line}, column {column}: {cells[column]!r} cannot be a name",
                expected=NAME_RULE,
                found=problem,
                fix="choose another name, such as my-desk_2",
            )
    for column, allowed in (("group", GROUPS), ("unit", UNITS)):
        if cells[column] not in allowed:
            raise SceneError(
                f"{path}, line {line}, column {column}: {cells[column]!r} is unknown",
                expected=f"one of {', '.join(allowed)}",
                fix=f"correct column {column} of that line",
            )
    source = cells["source"]
    where = f"{path}, line {line}, column source"
    if not source:
        raise SceneError(f"{where}: it is empty", fix="give world:<kind>:<seed>, or a folder of images")
    if source.startswith("world:"):
        if not WORLD_SOURCE.fullmatch(source):
            raise SceneError(
                f"{where}: {source!r} names no synthetic world",
                expected="world:<kind>:<seed>, such as world:tabletop:201",
                fix="correct the source",
            )
        folder = None
    elif source.startswith(DATA_PREFIX) and not data_root:
        folder = None
    else:
        start = (
            project_root(path) / Path(data_root).expanduser()
            if source.startswith(DATA_PREFIX)
            else project_root(path)
        )
        folder = (start / Path(source.removeprefix(DATA_PREFIX)).expanduser()).resolve()
        if checked_groups is None or cells["group"] in checked_groups:
            _check_source(where, folder)
    return SceneRow(cells["dataset"], cells["scene"], cells["group"], source, cells["unit"], folder)


def _check_source(where: str, folder: Path) -> None:
    """Refuse a source folder that is missing or has no images."""
    if not folder.is_dir():
        raise SceneError(
            f"{where}: folder {folder} {'is a file' if folder.exists() else 'is missing'}",
            expected="a folder of images; relative paths start from the project folder",
            fix="correct the path, or remove the line",
        )
    if not list_images(photo_folder(folder)) and not has_known_poses(folder):
        raise SceneError(
            f"{where}: folder {folder} has no images",
            expected=f"files of the kinds {', '.join(sorted(IMAGE_SUFFIXES))} in it or in its images/ folder",
            found=_what_else(folder),
            fix="correct the path, or convert the photographs to JPEG or PNG",
        )


def _what_else(folder: Path) -> str:
    """What a folder without readable images holds, in words."""
    kinds = Counter(file.suffix.lower() or "no suffix" for file in folder.iterdir() if file.is_file())
    if kinds:
        return ", ".join(f"{count} files {kind}" for kind, count in sorted(kinds.items()))
    below = sorted(sub.name for sub in folder.iterdir() if sub.is_dir() and list_images(sub))
    return f"folders with images below it: {', '.join(below[:5])}" if below else "nothing"


@dataclass(frozen=True)
class PhotoReport:
    """What a folder of photographs holds.

    Attributes:
        folder: where the photographs are.
        sizes: number of readable photographs per upright size (height, width), px.
        unreadable: (file name, reason) of each image that cannot be read.
        num_rotated: photographs that an EXIF flag turns upright.
        duplicates: groups of file names with identical bytes.
        passed_over: number of files per suffix that look like photographs but are not read.
    """

    folder: Path
    sizes: dict[tuple[int, int], int]
    unreadable: tuple[tuple[str, str], ...]
    num_rotated: int
    duplicates: tuple[tuple[str, ...], ...]
    passed_over: dict[str, int]

    @property
    def num_readable(self) -> int:
        """Photographs that can be read, identical copies included."""
        return sum(self.sizes.values())

    @property
    def num_distinct(self) -> int:
        """Photographs that can be read, identical copies counted once."""
        return self.num_readable - sum(len(names) - 1 for names in self.duplicates)

    def __str__(self) -> str:
        lines = [f"{self.num_readable} photographs in {self.folder}"]
        for (height, width), count in sorted(self.sizes.items(), key=lambda item: (-item[1], item[0])):
            lines.append(f"  {count:>5}  of {width} x {height} px (width x height)")
        if self.num_rotated:
            lines.append(f"  {self.num_rotated:>5}  turned upright by their EXIF flag")
        for names in self.duplicates:
            lines.append(f"  {len(names):>5}  are the same file: {', '.join(names)}")
        for suffix, count in sorted(self.passed_over.items()):
            lines.append(f"  {count:>5}  {suffix} passed over: convert them to JPEG or PNG to use them")
        if self.unreadable:
            lines.append(f"  {len(self.unreadable):>5}  cannot be read:")
            lines += [f"           {name}: {reason}" for name, reason in self.unreadable]
        return "\n".join(lines)


def inspect_photos(folder: Path) -> PhotoReport:
    """Read every photograph of a folder (or of its `images/`) in full and report what is there.

    Raises:
        SceneError: there is no such folder, or two photographs differ only in their suffix.
    """
    from PIL import Image, ImageOps

    folder = Path(folder)
    if not folder.is_dir():
        raise SceneError(
            f"photo folder {folder} {'is a file' if folder.exists() else 'is missing'}",
            fix="give the folder that holds the photographs",
        )
    where = photo_folder(folder)
    sizes: Counter[tuple[int, int]] = Counter()
    unreadable: list[tuple[str, str]] = []
    by_digest: dict[str, list[str]] = defaultdict(list)
    by_stem: dict[str, list[str]] = defaultdict(list)
    num_rotated = 0
    for path in list_images(where):
        if path.stat().st_size == 0:
            unreadable.append((path.name, "the file is empty"))
            continue
        try:
            with Image.open(path) as image:
                image.load()
                turned = image.getexif().get(0x0112, 1) not in (0, 1)
                width, height = ImageOps.exif_transpose(image).size
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
            reason = str(error).replace(str(path), path.name)
            unreadable.append((path.name, f"{reason} ({path.stat().st_size} bytes)"))
            continue
        sizes[height, width] += 1
        num_rotated += turned
        with path.open("rb") as stream:
            by_digest[hashlib.file_digest(stream, "sha256").hexdigest()].append(path.name)
        by_stem[path.stem].append(path.name)
    for names in by_stem.values():
        if len(names) > 1:
            raise SceneError(
                f"{len(names)} photographs in {where} would become the same view",
                found=", ".join(names),
                fix="rename or remove all but one: views are named after the file without its suffix",
            )
    passed_over = Counter(
        path.suffix.lower()
        for path in where.iterdir()
        if path.is_file() and path.suffix.lower() in OTHER_PHOTO_SUFFIXES
    )
    return PhotoReport(
        folder=where,
        sizes=dict(sizes),
        unreadable=tuple(unreadable),
        num_rotated=num_rotated,
        duplicates=tuple(tuple(names) for names in by_digest.values() if len(names) > 1),
        passed_over=dict(passed_over),
    )


def add_scene(sheet: Path, name: str, photos: Path, unit: str = "arbitrary") -> PhotoReport:
    """Append one's own photographs to the sheet as scene `photos/<name>`; an absent sheet is begun.

    The folder stays where it is: the sheet points at it, relative to the project where it lies
    inside.

    Args:
        sheet: the scene sheet.
        name: name of the new scene.
        photos: folder of photographs.
        unit: unit of lengths where the folder brings metric poses.

    Raises:
        SceneError: the name cannot be used or is taken, photographs cannot be read, or there are
            fewer than three different ones and no known poses. The sheet is unchanged then.
    """
    from hilsplat.base.artifacts import write_text

    sheet, photos = Path(sheet), Path(photos).expanduser().resolve()
    if problem := name_problem(name):
        raise SceneError(
            f"{name!r} cannot be the name of a scene",
            expected=NAME_RULE,
            found=problem,
            fix="choose another name, such as my-desk_2",
        )
    if unit not in UNITS:
        raise SceneError(f"unit {unit!r} is unknown", expected=f"one of {', '.join(UNITS)}")
    rows = read_sheet(sheet, checked_groups=()) if sheet.exists() else []
    taken = {row.name.casefold(): row for row in rows}
    if (row := taken.get(f"{PHOTOS}/{name}".casefold())) is not None:
        raise SceneError(
            f"scene {row.name} is already in {sheet}",
            found=f"source {row.source}",
            fix="choose another name, or remove its line from the sheet first",
        )
    report = inspect_photos(photos)
    if report.unreadable:
        raise SceneError(
            f"{len(report.unreadable)} photographs in {report.folder} cannot be read",
            found="; ".join(f"{file}: {reason}" for file, reason in report.unreadable),
            fix="remove them from the folder or replace them by whole copies, then try again",
        )
    if report.num_distinct < MIN_PHOTOS and not has_known_poses(photos):
        found = [f"{report.num_distinct} different ones that can be read"]
        found += [
            f"{count} {suffix} files passed over" for suffix, count in sorted(report.passed_over.items())
        ]
        raise SceneError(
            f"{report.folder} has too few photographs",
            expected=f"at least {MIN_PHOTOS} (20 or more are better)",
            found="; ".join(found),
            fix="add photographs (JPEG or PNG) of the same scene",
        )
    root = project_root(sheet)
    source = photos.relative_to(root).as_posix() if photos.is_relative_to(root) else str(photos)
    if not source.isprintable() or source.startswith("world:"):
        raise SceneError(f"the path {source!r} cannot stand in the scene sheet", fix="rename the folder")
    values = {"dataset": PHOTOS, "scene": name, "group": PHOTOS, "source": source, "unit": unit}
    if sheet.exists():
        text = sheet.read_text(encoding="utf-8-sig")
        header = [cell.strip() for cell in _content_lines(sheet)[0][1].split("\t")]
        if not text.endswith("\n"):
            text += "\n"
    else:
        header = list(COLUMNS)
        text = "\t".join(header) + "\n"
    write_text(sheet, text + "\t".join(values[column] for column in header) + "\n")
    return report
