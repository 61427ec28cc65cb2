"""Checks that a command replaces only its own earlier outputs."""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from hilsplat.base.artifacts import is_artifact, read_memo, write_json
from hilsplat.base.atomic import atomic_folder, changing, interrupted_outputs, was_interrupted
from hilsplat.base.errors import ArtifactError, ImageError
from hilsplat.base.files import FILES_OF_DESKTOPS
from hilsplat.base.images import opened_image
from hilsplat.base.lineage import read_provenance

SOFTWARE = {"Software": "hilsplat"}
"""Metadata of the PNGs that commands draw for users; these files have no provenance record."""

NOBODYS = (".snakemake_timestamp", *FILES_OF_DESKTOPS)
"""Files that a folder may lose: Snakemake and desktops write them."""

Stats = dict[str, list[int]]
"""Size and time of each file, or of two versions; empty if its writer ended early: it may be replaced."""


def require_replaceable(outputs: Sequence[Path], stage: str, inputs: Iterable[Path]) -> None:
    """Check that a stage can write its outputs without overwriting unrelated data.

    An existing file or folder may be replaced if it is empty, if the same stage wrote it according to the
    provenance of the first output, or if a process failed or was killed while writing it.

    Raises:
        ArtifactError: an output is in an artifact, is or contains another output, an input, or the working,
            home or root folder, or exists and is not an earlier output of the stage.
    """
    replaceable = {*_recorded_outputs(outputs[0], stage), *interrupted_outputs(outputs[0])}
    sources, paths = [Path(path).resolve() for path in inputs], [out.resolve() for out in outputs]
    occupied = {"working": Path.cwd()}
    with suppress(RuntimeError):  # a user without a home
        occupied["home"] = Path.home()
    for out, path in zip(outputs, paths, strict=True):
        require_outside_artifacts(out)
        if sum(other.is_relative_to(path) for other in paths) > 1:
            raise ArtifactError(f"{stage} writes other outputs to {out}, too", fix="choose another name")
        for source in sources:
            if source.is_relative_to(path):
                what = "is an input" if path == source else f"contains the input {source}"
                raise ArtifactError(f"output {out} {what} of {stage}", fix="choose another output")
        for name, folder in occupied.items():
            if folder.resolve().is_relative_to(path):
                raise ArtifactError(
                    f"output {out} is or contains the {name} folder", fix="choose a new file or folder"
                )
        if _is_something(out) and path not in replaceable and not was_interrupted(out):
            raise _foreign(out, stage, f"a new path, or an earlier output of {stage} with its provenance")


def require_outside_artifacts(out: Path) -> None:
    """Raise ArtifactError if an output is in an artifact, whose digest another file would change."""
    for folder in out.resolve().parents:
        if is_artifact(folder):
            raise ArtifactError(
                f"output {out} is in the artifact {folder}, which would then be damaged",
                fix="choose another output",
            )


def require_own_picture(path: Path) -> None:
    """Raise ArtifactError if a path is in an artifact, is not a .png, or exists and is not our picture."""
    require_outside_artifacts(path)
    if path.suffix.lower() != ".png":
        raise ArtifactError(f"output {path} is not a PNG file", expected="a name that ends in .png")
    if _is_something(path) and not _is_own_picture(path):
        raise _foreign(path)


def _is_own_picture(path: Path) -> bool:
    try:
        with opened_image(path) as image:
            return bool(image.info.get("Software") == SOFTWARE["Software"])
    except ImageError:
        return False


@contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder that replaces `folder`; raise ArtifactError if other files are in that one."""
    record, former = folder.with_name(f".{folder.name}.written.json"), _stats(folder, folder.rglob("*"))
    _require_written(folder, former, read_memo(record, Stats))
    with atomic_folder(folder) as temporary:
        yield temporary
        new = _stats(temporary, temporary.rglob("*"))  # recorded with the former files, in case of a kill now
        write_json(record, {name: new.get(name, []) + former.get(name, []) for name in new | former})


@contextmanager
def replaced_files(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Replace files of a folder in the block; raise ArtifactError if one is not from the last such block."""
    paths = [folder / name for name in names]
    require_outside_artifacts(paths[0])
    folder.mkdir(parents=True, exist_ok=True)  # an error then names the folder, not the record
    with changing(folder / ".hilsplat.written.json") as record:
        written = read_memo(record, Stats)
        _require_written(folder, _stats(folder, paths), written)
        others = {name: stat for name, stat in written.items() if name not in names}
        write_json(record, others | {name: [] for name in names})
        yield
        write_json(record, others | _stats(folder, paths))


def _require_written(folder: Path, stats: Stats, written: Stats) -> None:
    if others := sorted(name for name, stat in stats.items() if not _is_in(written.get(name), stat)):
        raise ArtifactError(
            f"{folder} contains files that hilsplat did not write, or that were changed later",
            found=", ".join(others[:3]),
            fix="move them elsewhere, or choose another folder (--out)",
        )


def _is_in(record: list[int] | None, stat: list[int]) -> bool:
    return record is not None and (not record or stat in (record[:2], record[2:]))


def _stats(folder: Path, paths: Iterable[Path]) -> Stats:
    files = [path for path in paths if path.name not in NOBODYS and (path.is_symlink() or path.is_file())]
    stats = {path.relative_to(folder).as_posix(): path.lstat() for path in files}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


def require_beginning(path: Path, line: str) -> None:
    """Raise ArtifactError if a table is in an artifact, or replaces a file whose first line is not `line`."""
    require_outside_artifacts(path)
    if not _is_something(path):
        return
    try:
        with path.open(encoding="utf-8") as stream:
            is_own = stream.readline().strip() == line.strip()
    except (OSError, ValueError):
        is_own = False
    if not is_own:
        raise _foreign(path)


def _foreign(path: Path, writer: str = "hilsplat", expected: str | None = None) -> ArtifactError:
    return ArtifactError(
        f"output {path} exists, but {writer} did not write it",
        expected=expected,
        found=_described(path),
        fix="choose another output, or remove this one first",
    )


def _recorded_outputs(artifact: Path, stage: str) -> set[Path]:
    try:
        record = read_provenance(artifact)
    except ArtifactError:
        return set()
    if record is None or record.stage != stage:
        return set()
    return {(artifact.parent / name).resolve() for name in record.outputs}


def _is_something(path: Path) -> bool:
    """Return whether a path exists and is not empty, ignoring Snakemake's marker of folders."""
    if not os.path.lexists(path):
        return False
    if path.is_dir():
        return bool(_entries(path))
    return not path.is_file() or path.stat().st_size > 0


def _entries(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name not in NOBODYS)


def _described(path: Path) -> str:
    if path.is_dir():
        names = _entries(path)
        return f"a folder of {len(names)} entries: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
    return f"a file of {path.stat().st_size} bytes" if path.is_file() else "neither a file nor a folder"
